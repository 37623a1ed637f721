//! Agents and their services in one process, over gRPC on loopback, in the built-in world.

use coma_geometry::se3;
use coma_tests::story::{self, Cast, Walk};

/// Two agents walk the same stretch of the room, half a submap apart, and know nothing of each other's start.
#[tokio::test(flavor = "multi_thread")]
async fn two_agents_that_see_the_same_places_end_with_one_map() {
    let cast = Cast::start(&["agent-00", "agent-01"]).await;
    let walks = [Walk { first_frame: 0, frames: 65 }, Walk { first_frame: 10, frames: 65 }];
    cast.stream(&walks).await;
    cast.drained().await;

    let graphs = [cast.graph(0).await, cast.graph(1).await];
    assert!(graphs.iter().all(|g| g.not_joined.is_empty()), "{:?}", graphs[0].not_joined);
    assert_eq!(graphs[0].components.len(), 1, "one map");
    assert_eq!(graphs[0].components, graphs[1].components, "and both agents have the same one, to the bit");
    let component = &graphs[0].components[0];
    let used = component
        .loops
        .iter()
        .filter(|l| l.weight > 0.5 && l.from.as_ref().unwrap().agent_id != l.to.as_ref().unwrap().agent_id);
    assert!(used.count() >= 2, "{:?}", component.loops);

    // The map's frame is the first camera of agent-00, so truth needs no alignment.
    for (agent, walk) in walks.iter().enumerate() {
        let poses = cast.map_from_camera(agent).await;
        assert_eq!(poses.len(), walk.frames, "every frame has a pose in the map");
        let map_from_world = story::truth(0).inverse();
        for (i, map_from_camera) in poses.iter().enumerate() {
            let (metres, radians) =
                se3::distance(map_from_camera, &(map_from_world * story::truth(walk.first_frame + i)));
            assert!(metres < 0.05 && radians < 0.03, "agent {agent} frame {i}: {metres} m, {radians} rad");
        }
    }
    cast.shutdown().await;
}

/// Whatever place-recognition and dpgo held is given to them again, without anyone asking for it.
#[tokio::test(flavor = "multi_thread")]
async fn services_that_start_anew_are_given_again_what_they_had() {
    let mut cast = Cast::start(&["agent-00"]).await;
    cast.stream(&[Walk { first_frame: 0, frames: 60 }]).await;
    cast.drained().await;
    let before = cast.submaps(0).await;
    assert!(before.len() >= 2, "{before:?}");

    cast.restart_services().await;
    assert!(cast.solve(0).await.is_err(), "nothing is left");
    cast.stream(&[Walk { first_frame: 60, frames: 50 }]).await;
    cast.drained().await;
    let submaps = cast.submaps(0).await;
    assert!(submaps.len() > before.len());
    for submap in submaps {
        let id = submap.id.unwrap();
        assert!(cast.is_indexed("agent-00", id.clone()).await, "{id:?} is not in the index");
    }
    let solved = cast.solve(0).await.expect("the graph is there");
    assert_eq!(solved.components, cast.graph(0).await.components);
    cast.shutdown().await;
}
