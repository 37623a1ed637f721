//! Place recognition that is not as one would wish: a model that cannot be loaded, an index or a graph that is full.

use coma_dpgo::DpgoConfig;
use coma_place_recognition::PlaceRecognitionConfig;
use coma_tests::story::{Cast, Walk};

/// One of two agents has fallen back to the builtin encoder: they still meet, and its users know.
#[tokio::test(flavor = "multi_thread")]
async fn an_agent_whose_model_is_missing_still_meets_the_other() {
    let broken = PlaceRecognitionConfig { models: vec!["absent.toml".into()], ..Default::default() };
    let places = vec![PlaceRecognitionConfig::default(), broken];
    let cast = Cast::start_with(&["agent-00", "agent-01"], &[], places, DpgoConfig::default()).await;
    meet(&cast).await;
    let warnings = cast.warnings(1).await;
    assert!(warnings.iter().any(|w| w.contains("absent.toml") && w.contains("without it")), "{warnings:?}");
    assert!(!cast.warnings(0).await.iter().any(|w| w.contains("absent.toml")));
    cast.shutdown().await;
}

/// The same, where the other agent's model does run: it describes in two spaces, and they meet in one.
#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs the shared data folder and ONNX Runtime"]
async fn an_agent_with_a_model_meets_one_that_has_fallen_back() {
    let folder = tempfile::tempdir().unwrap();
    let shared = std::env::var_os("COMA_SHARED").map(std::path::PathBuf::from).unwrap_or_else(|| {
        let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
        let found = root.ancestors().map(|f| f.join("shared")).find(|shared| shared.join("data").is_dir());
        found.expect("a folder shared/data beside the repository, or COMA_SHARED")
    });
    let model = shared.join("models/dinov2s14_block8_gem_224.onnx");
    let manifest = folder.path().join("m.toml");
    let text = format!(
        "model = {model:?}\n[input]\nname = \"pixel_values\"\nwidth = 224\nheight = 224\nmean = [0.485, 0.456, 0.406]\n\
         std = [0.229, 0.224, 0.225]\n[output]\nname = \"embedding\"\ndimension = 384\n[thresholds]\n\
         theta_sim = 0.8\ntheta_multi = 0.8\n"
    );
    std::fs::write(&manifest, text).unwrap();
    let with = |path: std::path::PathBuf| PlaceRecognitionConfig { models: vec![path], ..Default::default() };
    let places = vec![with(manifest), with("absent.toml".into())];
    let cast = Cast::start_with(&["agent-00", "agent-01"], &[], places, DpgoConfig::default()).await;
    meet(&cast).await;
    assert_eq!(cast.warnings(0).await, [""; 0], "its model runs");
    cast.shutdown().await;
}

async fn meet(cast: &Cast) {
    cast.stream(&[Walk { first_frame: 0, frames: 65 }, Walk { first_frame: 10, frames: 65 }]).await;
    cast.drained().await;
    for index in 0..2 {
        let graph = cast.graph(index).await;
        assert_eq!(graph.components.len(), 1, "one map: {:?}", graph.not_joined);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_full_index_is_told_to_users_and_the_agent_goes_on() {
    let places = vec![PlaceRecognitionConfig { max_anchors_per_index: 1, ..Default::default() }];
    let cast = Cast::start_with(&["agent-00"], &[], places, DpgoConfig::default()).await;
    cast.stream(&[Walk { first_frame: 0, frames: 45 }]).await;
    cast.drained().await;
    assert!(cast.submaps(0).await.len() >= 2);
    let warnings = cast.warnings(0).await;
    let told = warnings.iter().filter(|w| w.contains("max_anchors_per_index")).count();
    assert!(told >= 1 && warnings.iter().any(|w| w.contains("no longer recognised")), "{warnings:?}");
    cast.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_full_graph_is_told_to_users_and_the_agent_goes_on() {
    let dpgo = DpgoConfig { max_facts_per_graph: 3, ..Default::default() };
    let cast = Cast::start_with(&["agent-00"], &[], vec![PlaceRecognitionConfig::default()], dpgo).await;
    cast.stream(&[Walk { first_frame: 0, frames: 45 }]).await;
    cast.drained().await;
    let warnings = cast.warnings(0).await;
    assert!(
        warnings.iter().any(|w| w.contains("max_facts_per_graph") && w.contains("no longer corrected")),
        "{warnings:?}"
    );
    cast.shutdown().await;
}
