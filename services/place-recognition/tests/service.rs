//! The service over gRPC: pictures of the built-in world in, candidates out.

use coma_dataset::sequence::rgbd_frame;
use coma_dataset::world::{World, WorldSettings};
use coma_frame::RgbdFrame;
use coma_geometry::{AgentId, Epoch, SubmapId};
use coma_place::{Builtin, Encoder};
use coma_place_recognition::{Handle, PlaceRecognitionConfig, Server};
use coma_runtime::{ByteLedger, Channel, Class, channel};
use coma_wire::v1::place_recognition_client::PlaceRecognitionClient;
use coma_wire::{Wire, field_errors_of, v1};
use std::path::PathBuf;
use std::sync::LazyLock;
use tonic::{Code, Status};

type Client = PlaceRecognitionClient<Channel>;

static WORLD: LazyLock<World> = LazyLock::new(|| {
    World::new(WorldSettings { width: 160, height: 120, ..Default::default() }).expect("sound settings")
});

fn frame(index: usize) -> RgbdFrame {
    rgbd_frame(&WORLD.sequence(0).expect("the first agent"), index).expect("a frame")
}

async fn start(config: PlaceRecognitionConfig) -> (Handle, Client) {
    let handle = Server::start(config).await.expect("the service starts");
    let channel = channel(&handle.url, &Default::default(), &ByteLedger::default(), Class::Local).unwrap();
    (handle, PlaceRecognitionClient::new(channel))
}

fn describe_request(frame: &RgbdFrame) -> v1::DescribeRequest {
    let depth = coma_depth_codec::encode(&frame.depth_m, &Default::default()).unwrap();
    v1::DescribeRequest {
        color_encoding: v1::ColorEncoding::Rgb8.into(),
        color: frame.color.pixels().as_flattened().to_vec().into(),
        depth: depth.into(),
        camera: Some(frame.camera.to_wire()),
    }
}

async fn describe(client: &mut Client, index: usize) -> Vec<v1::Descriptor> {
    let request = describe_request(&frame(index));
    client.describe(request).await.expect("a description").into_inner().descriptors
}

fn id(agent: &str, number: u32) -> v1::SubmapId {
    SubmapId { agent: AgentId::new(agent).unwrap(), epoch: Epoch(1), number }.to_wire()
}

fn anchor(agent: &str, number: u32, descriptors: Vec<v1::Descriptor>) -> v1::Anchor {
    v1::Anchor { submap_id: Some(id(agent, number)), anchor_frame: u64::from(number) * 20, descriptors }
}

/// A made-up descriptor.
fn plain(space: &str, values: [i8; 4]) -> v1::Descriptor {
    v1::Descriptor { space: space.into(), scale: 0.01, values: values.map(i8::cast_unsigned).to_vec().into() }
}

fn insert(index: &str, anchors: Vec<v1::Anchor>) -> v1::InsertRequest {
    v1::InsertRequest { index: index.into(), anchors }
}

fn query(index: &str, submap_id: v1::SubmapId) -> v1::QueryRequest {
    v1::QueryRequest { index: index.into(), submap_id: Some(submap_id), limit: 0 }
}

#[track_caller]
fn assert_refused<T: std::fmt::Debug>(answer: Result<T, Status>, field: &str) {
    let status = answer.expect_err(field);
    assert_eq!(status.code(), Code::InvalidArgument, "{status}");
    assert_eq!(field_errors_of(&status)[0].field, field, "{status}");
}

#[tokio::test]
async fn an_agent_s_anchor_is_found_where_another_one_saw_the_same_place() {
    let (handle, mut client) = start(PlaceRecognitionConfig::default()).await;
    let mut anchors = Vec::new();
    // b walks a few frames ahead of a.
    for number in 0..3 {
        let frame = number as usize * 20;
        anchors.push(anchor("a", number, describe(&mut client, frame).await));
        anchors.push(anchor("b", number, describe(&mut client, frame + 3).await));
    }
    let inserted = client.insert(insert("b", anchors.clone())).await.unwrap().into_inner();
    assert_eq!(inserted.anchors_in_index, 6);

    let found = client.query(query("b", id("b", 1))).await.unwrap().into_inner();
    assert_eq!(found.candidates[0].submap_id, Some(id("a", 1)), "{found:?}");
    assert!(found.candidates[0].similarity > 0.95 && found.candidates[0].window_similarity > 0.88);
    assert_eq!(found.candidates[0].space, "builtin/1");
    // 20 frames apart in one agent is not a loop.
    assert!(found.candidates.iter().all(|c| c.submap_id.as_ref().unwrap().agent_id != "b"), "{found:?}");
    assert!(found.agents_without_common_space.is_empty());

    // Both calls may be repeated.
    let again = client.insert(insert("b", anchors)).await.unwrap().into_inner();
    assert_eq!(again, inserted);
    assert_eq!(client.query(query("b", id("b", 1))).await.unwrap().into_inner(), found);
    let one = v1::QueryRequest { limit: 1, ..query("b", id("b", 1)) };
    assert_eq!(client.query(one).await.unwrap().into_inner().candidates, found.candidates[..1]);

    // Another caller's index knows nothing of it.
    let status = client.query(query("a", id("b", 1))).await.unwrap_err();
    assert_eq!(status.code(), Code::NotFound);
    handle.shutdown().await;
}

#[tokio::test]
async fn the_builtin_descriptor_is_the_one_that_the_library_gives_and_encodings_agree() {
    let (handle, mut client) = start(PlaceRecognitionConfig::default()).await;
    let frame = frame(7);
    let own = Builtin::default().describe(&frame.color, Some(&frame.depth_m)).unwrap().to_wire();
    let raw = client.describe(describe_request(&frame)).await.unwrap().into_inner();
    assert_eq!(raw.descriptors, [own]);
    let mut png = std::io::Cursor::new(Vec::new());
    image::RgbImage::from_raw(160, 120, frame.color.pixels().as_flattened().to_vec())
        .unwrap()
        .write_to(&mut png, image::ImageFormat::Png)
        .unwrap();
    let request = v1::DescribeRequest {
        color_encoding: v1::ColorEncoding::Png.into(),
        color: png.into_inner().into(),
        depth: Default::default(),
        camera: Some(frame.camera.to_wire()),
    };
    assert_eq!(client.describe(request).await.unwrap().into_inner(), raw);
    let encoders = client.get_encoders(v1::GetEncodersRequest {}).await.unwrap().into_inner();
    assert_eq!((encoders.encoders[0].space.as_str(), encoders.encoders[0].dimension), ("builtin/1", 221));
    assert!(encoders.warnings.is_empty());
    handle.shutdown().await;
}

#[tokio::test]
async fn bad_pictures_are_refused_by_field_and_the_service_goes_on() {
    let config = PlaceRecognitionConfig { max_pixels: 160 * 120, ..Default::default() };
    let (handle, mut client) = start(config).await;
    let good = describe_request(&frame(0));
    let camera = |f: &dyn Fn(&mut v1::Intrinsics)| {
        let mut camera = good.camera.unwrap();
        f(&mut camera);
        Some(camera)
    };
    let jpeg = v1::ColorEncoding::Jpeg.into();
    let bad: Vec<(&str, v1::DescribeRequest)> = vec![
        ("camera", v1::DescribeRequest { camera: None, ..good.clone() }),
        ("camera.fx", v1::DescribeRequest { camera: camera(&|c| c.fx = f64::NAN), ..good.clone() }),
        ("camera", v1::DescribeRequest { camera: camera(&|c| c.width = 8000), ..good.clone() }),
        ("color", v1::DescribeRequest { camera: camera(&|c| c.width = 150), ..good.clone() }),
        ("color", v1::DescribeRequest { color: Default::default(), ..good.clone() }),
        ("color", v1::DescribeRequest { color: good.color.slice(1..), ..good.clone() }),
        ("color", v1::DescribeRequest { color_encoding: jpeg, ..good.clone() }),
        ("color_encoding", v1::DescribeRequest { color_encoding: 0, ..good.clone() }),
        ("color_encoding", v1::DescribeRequest { color_encoding: 77, ..good.clone() }),
        ("depth", v1::DescribeRequest { depth: vec![7; 40].into(), ..good.clone() }),
        ("depth", v1::DescribeRequest { depth: good.depth.slice(..good.depth.len() - 9), ..good.clone() }),
    ];
    for (field, request) in bad {
        assert_refused(client.describe(request).await, field);
    }
    // Too small to say anything of.
    let tiny = v1::DescribeRequest {
        camera: Some(v1::Intrinsics { width: 8, height: 8, fx: 8.0, fy: 8.0, cx: 3.5, cy: 3.5 }),
        color: vec![0; 192].into(),
        depth: Default::default(),
        ..good.clone()
    };
    assert_refused(client.describe(tiny).await, "color");
    client.describe(good).await.expect("it goes on");
    handle.shutdown().await;
}

#[tokio::test]
async fn bad_anchors_and_queries_are_refused_by_field_and_nothing_of_the_call_is_taken() {
    let (handle, mut client) = start(PlaceRecognitionConfig::default()).await;
    let good = anchor("a", 0, vec![plain("s", [1, 2, 3, 4])]);
    let with = |f: &dyn Fn(&mut v1::Anchor)| {
        let mut bad = anchor("a", 1, vec![plain("s", [1, 2, 3, 4])]);
        f(&mut bad);
        insert("i", vec![good.clone(), bad])
    };
    let cases = [
        ("index", insert("", vec![])),
        ("index", insert(&"x".repeat(200), vec![])),
        ("anchors", insert("i", vec![good.clone(); 1025])),
        ("anchors[1].submap_id", with(&|a| a.submap_id = None)),
        ("anchors[1].submap_id.agent_id", with(&|a| a.submap_id = Some(v1::SubmapId::default()))),
        ("anchors[1].descriptors", with(&|a| a.descriptors.clear())),
        ("anchors[1].descriptors", with(&|a| a.descriptors = vec![plain("s", [1; 4]); 9])),
        ("anchors[1].descriptors[0].scale", with(&|a| a.descriptors[0].scale = f32::NAN)),
        ("anchors[1].descriptors[0].values", with(&|a| a.descriptors[0].values = vec![0; 600].into())),
        ("anchors[1].descriptors[1].space", with(&|a| a.descriptors.push(plain("s", [4; 4])))),
    ];
    for (field, request) in cases {
        assert_refused(client.insert(request).await, field);
    }
    assert_refused(
        client.query(v1::QueryRequest { submap_id: None, ..query("i", id("a", 0)) }).await,
        "submap_id",
    );
    assert_refused(client.query(v1::QueryRequest { limit: 1001, ..query("i", id("a", 0)) }).await, "limit");
    let status = client.query(query("i", id("a", 0))).await.unwrap_err();
    assert_eq!(status.code(), Code::NotFound, "nothing was taken: {status}");
    handle.shutdown().await;
}

#[tokio::test]
async fn indices_are_bounded_and_a_caller_whose_index_went_inserts_again() {
    let config = PlaceRecognitionConfig { max_indices: 2, max_anchors_per_index: 3, ..Default::default() };
    let (handle, mut client) = start(config).await;
    let one = |number| anchor("a", number, vec![plain("s", [1, 2, 3, 4])]);
    for index in ["x", "y"] {
        client.insert(insert(index, vec![one(0), one(1)])).await.unwrap();
    }
    let status = client.insert(insert("y", vec![one(2), one(3)])).await.unwrap_err();
    assert_eq!(status.code(), Code::ResourceExhausted);
    assert!(status.message().contains("max_anchors_per_index"), "{status}");
    let held = client.insert(insert("y", vec![one(2)])).await.unwrap().into_inner().anchors_in_index;
    assert_eq!(held, 3, "what fits is taken later");
    // x is used, so y is the one that makes room.
    client.query(query("x", id("a", 0))).await.unwrap();
    client.insert(insert("z", vec![one(0)])).await.unwrap();
    client.query(query("x", id("a", 0))).await.expect("x stays");
    assert_eq!(client.query(query("y", id("a", 0))).await.unwrap_err().code(), Code::NotFound);
    let held = client.insert(insert("y", vec![one(0)])).await.unwrap().into_inner().anchors_in_index;
    assert_eq!(held, 1, "the caller sees that its other anchors are gone");
    handle.shutdown().await;
}

#[tokio::test]
async fn agents_without_a_common_space_are_named() {
    let (handle, mut client) = start(PlaceRecognitionConfig::default()).await;
    let builtin = describe(&mut client, 0).await;
    let anchors = vec![
        anchor("a", 0, builtin.clone()),
        anchor("b", 0, vec![builtin[0].clone(), plain("other/1", [1; 4])]),
        anchor("c", 0, vec![plain("other/1", [1; 4])]),
        // The same foreign space: but this service knows no thresholds for it.
        anchor("d", 0, vec![plain("other/1", [1; 4])]),
    ];
    client.insert(insert("a", anchors)).await.unwrap();
    let strangers = async |client: &mut Client, agent| {
        client.query(query("a", id(agent, 0))).await.unwrap().into_inner().agents_without_common_space
    };
    assert_eq!(strangers(&mut client, "a").await, ["c", "d"]);
    assert_eq!(strangers(&mut client, "c").await, ["a", "b", "d"]);
    handle.shutdown().await;
}

/// A model's manifest.
fn manifest(model: &str, input: &str, output: &str, side: u32, dimension: u32) -> String {
    format!(
        r#"
model = "{model}"
[input]
name = "{input}"
width = {side}
height = {side}
mean = [0.485, 0.456, 0.406]
std = [0.229, 0.224, 0.225]
[output]
name = "{output}"
dimension = {dimension}
[thresholds]
theta_sim = 0.6
theta_multi = 0.5
"#
    )
}

/// The shared folder: `COMA_SHARED`, or `shared` beside one of the folders above this crate.
fn shared() -> PathBuf {
    if let Some(folder) = std::env::var_os("COMA_SHARED") {
        return folder.into();
    }
    let start = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    let found = start.ancestors().map(|folder| folder.join("shared")).find(|s| s.join("data").is_dir());
    found.expect("a folder shared/data beside the repository, or COMA_SHARED")
}

#[tokio::test]
#[ignore = "needs ONNX Runtime and the shared model"]
async fn a_model_describes_beside_the_builtin_encoder_and_finds_places() {
    let folder = tempfile::tempdir().unwrap();
    let model = shared().join("models/dinov2s14_block8_gem_224.onnx");
    let text = manifest(model.to_str().unwrap(), "pixel_values", "embedding", 224, 384);
    std::fs::write(folder.path().join("dinov2.toml"), text).unwrap();
    let config = PlaceRecognitionConfig {
        data: folder.path().into(),
        models: vec!["dinov2.toml".into()],
        ..Default::default()
    };
    let (handle, mut client) = start(config).await;
    let answer = client.get_encoders(v1::GetEncodersRequest {}).await.unwrap().into_inner();
    assert_eq!(answer.warnings, [""; 0]);
    let known: Vec<_> = answer.encoders.iter().map(|e| (e.name.as_str(), e.dimension)).collect();
    assert_eq!(known, [("builtin", 221), ("dinov2", 384)]);
    let first = describe(&mut client, 0).await;
    let spaces =
        |descriptors: &[v1::Descriptor]| descriptors.iter().map(|d| d.space.clone()).collect::<Vec<_>>();
    assert_eq!(spaces(&first), answer.encoders.iter().map(|e| e.space.clone()).collect::<Vec<_>>());
    // An anchor with the model's descriptor alone meets the other in that space.
    let anchors = vec![anchor("a", 0, first), anchor("b", 0, describe(&mut client, 3).await[1..].to_vec())];
    client.insert(insert("i", anchors)).await.unwrap();
    let found = client.query(query("i", id("b", 0))).await.unwrap().into_inner();
    assert_eq!(found.candidates[0].space, answer.encoders[1].space);
    assert!(found.candidates[0].similarity > 0.8, "{found:?}");
    handle.shutdown().await;
}

#[tokio::test]
async fn models_that_cannot_be_loaded_leave_the_builtin_encoder_at_work() {
    let folder = tempfile::tempdir().unwrap();
    let manifest = manifest("m.onnx", "x", "y", 8, 4);
    std::fs::write(folder.path().join("m.toml"), manifest).unwrap();
    std::fs::write(folder.path().join("m.onnx"), b"no model").unwrap();
    let mut config = PlaceRecognitionConfig {
        data: folder.path().into(),
        models: vec!["absent.toml".into(), "m.toml".into()],
        ..Default::default()
    };
    config.onnx.library = Some(folder.path().join("libabsent.so"));
    let (handle, mut client) = start(config).await;
    let answer = client.get_encoders(v1::GetEncodersRequest {}).await.unwrap().into_inner();
    assert_eq!(answer.encoders.iter().map(|e| e.name.as_str()).collect::<Vec<_>>(), ["builtin"]);
    assert_eq!(answer.warnings.len(), 2, "{:?}", answer.warnings);
    assert!(answer.warnings[0].contains("absent.toml"), "{:?}", answer.warnings);
    assert!(answer.warnings[1].contains("m.toml"), "{:?}", answer.warnings);
    assert_eq!(describe(&mut client, 0).await.len(), 1);
    handle.shutdown().await;
}

#[tokio::test]
async fn settings_out_of_range_are_named() {
    let refused = async |config| match Server::start(config).await {
        Ok(_) => panic!("it started"),
        Err(e) => e.to_string(),
    };
    let mut config = PlaceRecognitionConfig::default();
    config.candidates.window = u32::MAX;
    assert!(refused(config).await.starts_with("candidates.window = 4294967295"));
    let config = PlaceRecognitionConfig { models: vec!["m".into(); 8], ..Default::default() };
    assert!(refused(config).await.starts_with("models = 8"));
}

#[tokio::test]
async fn health_tells_who_serves_and_shutdown_ends_it() {
    let (handle, mut client) = start(PlaceRecognitionConfig::default()).await;
    let url = handle.url.clone();
    let channel = || channel(&url, &Default::default(), &ByteLedger::default(), Class::Local).unwrap();
    let mut health = tonic_health::pb::health_client::HealthClient::new(channel());
    let service = "coma.v1.PlaceRecognition".to_owned();
    let check = tonic_health::pb::HealthCheckRequest { service };
    assert_eq!(health.check(check).await.unwrap().into_inner().status, 1);
    client.get_encoders(v1::GetEncodersRequest {}).await.unwrap();
    handle.shutdown().await;
    let gone = PlaceRecognitionClient::new(channel()).get_encoders(v1::GetEncodersRequest {}).await;
    assert_eq!(gone.unwrap_err().code(), Code::Unavailable);
}
