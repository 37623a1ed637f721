//! The gateway in front of two real agents, seen over HTTP and through a browser.

mod page;

use coma_geometry::{se3, tum};
use coma_tests::story::{self, Cast, Walk};
use coma_viewer_gateway::{GatewayConfig, Server};
use serde_json::{Value, json};

const NAMES: [&str; 2] = ["agent-00", "agent-01"];
const WALKS: [Walk; 2] = [Walk { first_frame: 0, frames: 65 }, Walk { first_frame: 10, frames: 65 }];

#[tokio::test(flavor = "multi_thread")]
async fn the_gateway_shows_two_agents_and_the_map_that_they_made() {
    let cast = Cast::start(&NAMES).await;
    let listen = ([127, 0, 0, 1], 0).into();
    // On a machine that is busy with mapping and a browser, agents may take their time.
    let config = GatewayConfig {
        listen,
        agents: cast.urls(),
        status_timeout_s: 30.0,
        call_timeout_s: 120.0,
        ..Default::default()
    };
    let gateway = Server::start(config).await.unwrap();
    let page = page::Page::open(&gateway.url, WALKS[0].frames).await;

    cast.stream(&WALKS).await;
    cast.drained().await;

    let http = Http(gateway.url.clone());
    agents_say_how_they_fare(&http).await;
    trajectories_are_true_and_their_stamps_exact(&http).await;
    submaps_lie_in_one_map_and_their_surfels_are_there(&http).await;
    the_merged_map_is_smaller_than_its_parts(&http).await;
    a_rendering_shows_what_the_camera_saw(&http).await;
    the_graph_has_loops_and_reasons(&http).await;
    old_maps_are_related_to_the_new_one(&http).await;
    bytes_are_told_by_type(&http).await;
    if let Some(page) = page {
        page.shows_both_agents().await;
    }

    // One agent goes: the gateway says so, and goes on with the other.
    cast.shutdown().await;
    http.wait_for("/api/v1/agents", |answer| {
        answer["agents"].as_array().unwrap().iter().all(|a| a["reachable"] == json!(false))
    })
    .await;
    let (_, answer) = http.json("/api/v1/submaps").await;
    assert_eq!(answer["unreachable"].as_array().unwrap().len(), 2, "{answer}");
    gateway.shutdown().await;
}

struct Http(String);

impl Http {
    async fn get(&self, path: &str) -> reqwest::Response {
        reqwest::get(format!("{}{path}", self.0)).await.unwrap()
    }

    async fn json(&self, path: &str) -> (u16, Value) {
        let response = self.get(path).await;
        (response.status().as_u16(), response.json().await.unwrap())
    }

    async fn wait_for(&self, path: &str, holds: impl Fn(&Value) -> bool) -> Value {
        let begin = std::time::Instant::now();
        loop {
            let (_, answer) = self.json(path).await;
            if holds(&answer) {
                return answer;
            }
            assert!(begin.elapsed().as_secs() < 30, "{path}: {answer}");
            tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        }
    }
}

async fn agents_say_how_they_fare(http: &Http) {
    let fine = |answer: &Value| {
        let agents = answer["agents"].as_array().unwrap();
        agents.len() == 2
            && agents.iter().all(|a| {
                a["status"]["frames_processed"] == json!(65) && a["status"]["generation"].is_object()
            })
    };
    let answer = http.wait_for("/api/v1/agents", fine).await;
    for (agent, name) in answer["agents"].as_array().unwrap().iter().zip(NAMES) {
        assert_eq!(
            (&agent["id"], &agent["reachable"], &agent["status"]["state"]),
            (&json!(name), &json!(true), &json!("tracking"))
        );
        assert_eq!(
            agent["status"]["generation"]["map"].as_str().unwrap().split('/').next(),
            Some("agent-00")
        );
        assert!(agent["status"]["surfels"].as_u64().unwrap() > 1000, "{agent}");
    }
}

async fn trajectories_are_true_and_their_stamps_exact(http: &Http) {
    let map_from_world = story::truth(0).inverse();
    for (name, walk) in NAMES.iter().zip(WALKS) {
        let text = http.get(&format!("/api/v1/agents/{name}/trajectory.tum")).await.text().await.unwrap();
        let poses = tum::parse(&text).unwrap();
        assert_eq!(poses.len(), walk.frames, "{text}");
        for (i, pose) in poses.iter().enumerate() {
            let (metres, radians) =
                se3::distance(&pose.pose, &(map_from_world * story::truth(walk.first_frame + i)));
            assert!(metres < 0.05 && radians < 0.03, "{name} frame {i}: {metres} m, {radians} rad");
            assert_eq!(pose.stamp, walk.stamp(i), "{name} frame {i}");
        }
        let (_, answer) = http.json(&format!("/api/v1/trajectories?agent={name}&first_sequence=60")).await;
        let frames = answer["trajectories"][0]["poses"].as_array().unwrap();
        assert_eq!(frames.len(), walk.frames - 60);
        assert_eq!(frames[0]["stamp_ns"], json!(walk.stamp(60).0.to_string()));
    }
}

async fn submaps_lie_in_one_map_and_their_surfels_are_there(http: &Http) {
    let (_, answer) = http.json("/api/v1/submaps").await;
    let submaps = answer["submaps"].as_array().unwrap();
    assert!(submaps.len() >= 4, "{answer}");
    for submap in submaps {
        assert_eq!(submap["map"], submaps[0]["map"]);
        assert_eq!(submap["closed"], json!(true));
        let (id, revision) = (submap["id"].as_str().unwrap(), submap["revision"].as_str().unwrap());
        let path = format!("/api/v1/submaps/{id}/surfels?revision={revision}");
        for kept in [false, true] {
            let response = http.get(&path).await;
            assert_eq!(response.headers()["etag"], format!("\"{revision}\""), "{id} kept: {kept}");
            assert!(response.headers()["cache-control"].to_str().unwrap().contains("immutable"));
            let packed = response.bytes().await.unwrap();
            let surfels = coma_surfel::pack::unpack(&packed, 10_000_000).unwrap();
            assert_eq!(json!(surfels.len()), submap["surfels"], "{id}");
        }
        let ply = http.get(&format!("/api/v1/submaps/{id}/surfels?format=ply")).await.bytes().await.unwrap();
        assert_eq!(json!(coma_surfel::ply::read(&ply[..], 10_000_000).unwrap().len()), submap["surfels"]);
        let known = reqwest::Client::new()
            .get(format!("{}{path}", http.0))
            .header("if-none-match", format!("\"{revision}\""));
        assert_eq!(known.send().await.unwrap().status(), 304);
    }
    let (_, open) = http.json("/api/v1/submaps?open=true").await;
    assert_eq!(open["submaps"], json!([]));
    let (status, problem) = http.json("/api/v1/submaps/agent-00/1/s0/surfels").await;
    assert_eq!((status, &problem["error"]["field"]), (404, &json!("number")), "{problem}");
}

async fn the_merged_map_is_smaller_than_its_parts(http: &Http) {
    let (_, maps) = http.json("/api/v1/maps").await;
    let map = &maps["maps"][0];
    assert_eq!((maps["maps"].as_array().unwrap().len(), &map["agents"]), (1, &json!(NAMES)), "{maps}");
    let response = http.get("/api/v1/map.ply").await;
    assert_eq!(response.headers()["x-coma-map"], map["id"].as_str().unwrap());
    let ply = response.bytes().await.unwrap();
    let merged = coma_surfel::ply::read(&ply[..], 10_000_000).unwrap();
    let parts = map["surfels"].as_u64().unwrap() as usize;
    // Both agents saw the same stretch: much of it is dropped, but not nearly all.
    assert!(merged.len() < parts * 9 / 10 && merged.len() > parts / 5, "{} of {parts}", merged.len());
}

async fn a_rendering_shows_what_the_camera_saw(http: &Http) {
    // The first camera of agent-00 is the map's frame.
    let camera = story::camera();
    let viewpoint = format!(
        "tx_m=0&ty_m=0&tz_m=0&qx=0&qy=0&qz=0&qw=1&width={}&height={}&fx={}&fy={}&cx={}&cy={}",
        camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
    );
    let response = http.get(&format!("/api/v1/render?{viewpoint}")).await;
    assert_eq!(response.headers()["content-type"], "image/png");
    let file = response.bytes().await.unwrap();
    let rendered = image::load_from_memory(&file).unwrap().into_rgb8();
    let seen = story::picture(WALKS[0].first_frame);
    assert_eq!((rendered.width(), rendered.height()), (camera.width, camera.height));
    let squares: f64 =
        rendered.as_raw().iter().zip(&seen).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
    let psnr_db = 10.0 * (255.0f64.powi(2) * seen.len() as f64 / squares).log10();
    assert!(psnr_db > 20.0, "{psnr_db} dB");
    for (query, kind) in [
        ("output=depth", "image/png"),
        ("output=normal&format=jpeg", "image/jpeg"),
        ("format=jpeg", "image/jpeg"),
    ] {
        let response = http.get(&format!("/api/v1/render?{viewpoint}&{query}")).await;
        assert_eq!(response.headers()["content-type"], kind);
        assert!(image::load_from_memory(&response.bytes().await.unwrap()).is_ok(), "{query}");
    }
    let body = json!({
        "map_from_camera": {"tx_m": 0, "ty_m": 0, "tz_m": 0, "qx": 0, "qy": 0, "qz": 0, "qw": 1},
        "camera": {"width": camera.width, "height": camera.height, "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy},
    });
    let posted = reqwest::Client::new()
        .post(format!("{}/api/v1/render", http.0))
        .body(body.to_string())
        .send()
        .await
        .unwrap();
    assert_eq!(posted.bytes().await.unwrap(), file, "posted or asked for, the picture is the same");
}

async fn the_graph_has_loops_and_reasons(http: &Http) {
    let (_, graph) = http.json("/api/v1/graph").await;
    let loops = graph["loops"].as_array().unwrap();
    let accepted: Vec<&Value> = loops.iter().filter(|l| l["accepted"] == json!(true)).collect();
    assert!(
        accepted.iter().any(|l| l["counts"] == json!(true) && l["solution"]["weight"].as_f64() > Some(0.5)),
        "{loops:?}"
    );
    for rejected in loops.iter().filter(|l| l["accepted"] == json!(false)) {
        assert!(
            !rejected["reason"].as_str().unwrap().is_empty() && rejected["message"].is_string(),
            "{rejected}"
        );
    }
    let (nodes, odometry) = (graph["submaps"].as_array().unwrap(), graph["odometry"].as_array().unwrap());
    assert!(nodes.len() >= 4 && odometry.len() + 2 >= nodes.len(), "{} {}", nodes.len(), odometry.len());
    assert_eq!(graph["components"][0]["submaps"].as_array().unwrap().len(), nodes.len());
}

async fn old_maps_are_related_to_the_new_one(http: &Http) {
    let (_, graph) = http.json("/api/v1/graph").await;
    let first = |name: &str| {
        let nodes = graph["submaps"].as_array().unwrap();
        let id = nodes.iter().map(|n| n["id"].as_str().unwrap()).find(|id| id.starts_with(name)).unwrap();
        id.rsplit_once('/').unwrap().0.to_owned()
    };
    // What was drawn in agent-01's own map, before they joined, lies here in the common one.
    let (old, new) = (first("agent-01"), first("agent-00"));
    let (_, relation) = http.json(&format!("/api/v1/maps/relation?old={old}&new={new}")).await;
    let pose = &relation["new_map_from_old_map"];
    let found = [&pose["tx_m"], &pose["ty_m"], &pose["tz_m"]].map(|v| v.as_f64().unwrap());
    let known = story::truth(0).inv_mul(&story::truth(WALKS[1].first_frame)).translation.vector;
    let off_m = (nalgebra::Vector3::from(found) - known).norm();
    assert!(off_m < 0.05, "{relation}: off by {off_m} m");
    let (_, none) = http.json(&format!("/api/v1/maps/relation?old=nobody/1&new={new}")).await;
    assert!(
        none["new_map_from_old_map"].is_null() && none["reason"].as_str().unwrap().contains("nobody/1"),
        "{none}"
    );
}

async fn bytes_are_told_by_type(http: &Http) {
    let metrics = http.get("/metrics").await.text().await.unwrap();
    let line = "coma_agent_sent_bytes_total{agent=\"agent-00\",class=\"peer\",message_type=\"PullEntriesResponse\"} ";
    let bytes = metrics.lines().find_map(|l| l.strip_prefix(line)).unwrap_or_else(|| panic!("{metrics}"));
    assert!(bytes.parse::<f64>().unwrap() > 1000.0, "{bytes}");
    assert!(metrics.contains("coma_agent_frames_processed_total{agent=\"agent-01\"} 65"), "{metrics}");
}
