//! Whatever a client sends, an agent names what is wrong with it, goes on, and loses nothing that it had accepted.

use coma_tests::story::{Cast, Walk};
use coma_wire::v1::stream_frames_response::Event;
use coma_wire::{Wire, field_errors_of, v1};
use tokio_stream::wrappers::ReceiverStream;
use tonic::Code;

const WALK: Walk = Walk { first_frame: 0, frames: 12 };

fn session(id: &str) -> v1::OpenSessionRequest {
    v1::OpenSessionRequest {
        session_id: id.into(),
        calibration: Some(WALK.calibration().to_wire()),
        policy: v1::QueuePolicy::Block.into(),
        clock_domain: v1::ClockDomain::Device.into(),
        hold_out_every: 0,
    }
}

fn color(session: &mut v1::OpenSessionRequest) -> &mut v1::Intrinsics {
    session.calibration.as_mut().unwrap().color.as_mut().unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn sessions_that_make_no_sense_are_refused_by_field() {
    type Change = fn(&mut v1::OpenSessionRequest);
    let changes: [(&str, Change); 9] = [
        ("calibration", |s| s.calibration = None),
        ("calibration.color", |s| s.calibration.as_mut().unwrap().color = None),
        ("calibration.color.fx", |s| color(s).fx = f64::NAN),
        ("calibration.color.fy", |s| color(s).fy = 0.0),
        ("calibration.color.width", |s| color(s).width = 0),
        ("calibration.color.height", |s| color(s).height = 1 << 30),
        ("calibration.depth_units_per_metre", |s| {
            s.calibration.as_mut().unwrap().depth_units_per_metre = 0.0
        }),
        ("session_id", |s| s.session_id = "No Good".into()),
        ("policy", |s| s.policy = 99),
    ];
    let cast = Cast::start(&["agent-00"]).await;
    for (field, change) in changes {
        let mut request = session("bad");
        change(&mut request);
        let status = cast.agent(0).open_session(request).await.expect_err(field);
        assert_eq!(status.code(), Code::InvalidArgument, "{field}: {status}");
        let named: Vec<String> = field_errors_of(&status).into_iter().map(|e| e.field).collect();
        assert_eq!(named, [field], "{status}");
    }
    cast.agent(0).open_session(session("good")).await.expect("the agent goes on");
    cast.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn frames_that_make_no_sense_are_refused_by_field_and_the_stream_goes_on() {
    type Change = fn(&mut v1::Frame);
    // Frame 5 is spoilt in each of these ways before it comes as it should be.
    let changes: [(&str, Change); 12] = [
        ("frame.color", |f| f.color = f.color.slice(..100)),
        ("frame.color", |f| {
            (f.color_encoding, f.color) = (v1::ColorEncoding::Jpeg.into(), f.color.slice(..5000))
        }),
        ("frame.color", |f| {
            (f.color_encoding, f.color) = (v1::ColorEncoding::Png.into(), Default::default())
        }),
        ("frame.color_encoding", |f| f.color_encoding = 77),
        ("frame.color_encoding", |f| f.color_encoding = 0),
        ("frame.depth", |f| f.depth = f.depth.slice(2..)),
        ("frame.depth", |f| f.depth_encoding = v1::DepthEncoding::Png16.into()),
        ("frame.depth", |f| f.depth_encoding = v1::DepthEncoding::Coma.into()),
        ("frame.depth_encoding", |f| f.depth_encoding = -3),
        ("frame.camera_id", |f| f.camera_id = 7),
        ("frame.sequence", |f| f.sequence = 4),
        ("frame.stamp_ns", |f| f.stamp_ns = 0),
    ];
    let cast = Cast::start(&["agent-00"]).await;
    let mut agent = cast.agent(0);
    agent.open_session(session("walk")).await.unwrap();
    let mut messages: Vec<Option<v1::Frame>> = Vec::new();
    for index in 0..WALK.frames {
        if index == 5 {
            for (_, change) in changes {
                let mut frame = WALK.message(index);
                change(&mut frame);
                messages.push(Some(frame));
            }
            messages.push(None);
        }
        messages.push(Some(WALK.message(index)));
    }
    let (send, frames) = tokio::sync::mpsc::channel(4);
    tokio::spawn(async move {
        for frame in messages {
            let message = v1::StreamFramesRequest { session_id: "walk".into(), frame };
            send.send(message).await.expect("the stream goes on");
        }
    });
    let mut answers = agent.stream_frames(ReceiverStream::new(frames)).await.unwrap().into_inner();
    let (mut refused, mut processed) = (Vec::new(), None);
    while let Some(answer) = answers.message().await.unwrap() {
        match answer.event {
            Some(Event::Ack(ack)) => processed = ack.processed_through,
            Some(Event::Refusal(refusal)) => refused.push(refusal.field),
            None => {}
        }
    }
    let expected: Vec<&str> = changes.iter().map(|(field, _)| *field).chain(["frame"]).collect();
    assert_eq!(refused, expected);
    assert_eq!(processed, Some(WALK.frames as u64 - 1), "every good frame was processed");
    agent.close_session(v1::CloseSessionRequest { session_id: "walk".into() }).await.unwrap();
    assert_eq!(cast.poses(0).await, WALK.frames);
    cast.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn unknown_sessions_and_messages_over_the_limit_end_the_call_and_nothing_else() {
    let cast = Cast::start(&["agent-00"]).await;
    let mut agent = cast.agent(0);
    let one = |session_id: &str, frame: v1::Frame| {
        let message = v1::StreamFramesRequest { session_id: session_id.into(), frame: Some(frame) };
        let mut agent = agent.clone();
        async move {
            let mut answers = agent.stream_frames(tokio_stream::iter([message])).await?.into_inner();
            while answers.message().await?.is_some() {}
            Ok::<(), tonic::Status>(())
        }
    };
    let status = one("nobody", WALK.message(0)).await.unwrap_err();
    assert_eq!(status.code(), Code::NotFound, "{status}");
    assert!(status.message().contains("nobody"), "{status}");

    cast.agent(0).open_session(session("walk")).await.unwrap();
    let mut huge = WALK.message(0);
    huge.color = vec![0; 17 << 20].into();
    assert!(one("walk", huge).await.is_err(), "over the limit of 16 MiB");
    one("walk", WALK.message(0)).await.expect("the session is still there");

    let status =
        agent.close_session(v1::CloseSessionRequest { session_id: "other".into() }).await.unwrap_err();
    assert_eq!(status.code(), Code::NotFound, "{status}");
    let status = agent.open_session(session("second")).await.unwrap_err();
    assert_eq!(status.code(), Code::FailedPrecondition, "one camera at a time: {status}");
    cast.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_peer_that_cannot_be_reached_is_told_by_name_and_disturbs_nothing() {
    // A port that was free a moment ago: nobody answers there.
    let nobody = {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        format!("http://{}", listener.local_addr().unwrap())
    };
    let cast = Cast::start_with_peers(&["agent-00"], std::slice::from_ref(&nobody)).await;
    cast.stream(&[Walk { first_frame: 0, frames: 3 }]).await;
    let told = async {
        loop {
            let status = cast.agent(0).get_status(v1::GetStatusRequest {}).await.unwrap().into_inner();
            if let Some(peer) = status.peers.iter().find(|p| p.endpoint == nobody && !p.last_error.is_empty())
            {
                return peer.clone();
            }
            tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        }
    };
    let peer = tokio::time::timeout(std::time::Duration::from_secs(30), told).await.expect("it is told");
    assert!(!peer.alive);
    cast.drained().await;
    cast.shutdown().await;
}
