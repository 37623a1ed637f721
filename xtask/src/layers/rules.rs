//! The rules as tables: this file is what to read, and what to change when the layout does.

/// Our crates by layer, lowest first; a crate is named as its folder is. Imports point to lower layers.
pub const LAYERS: &[(u8, &[&str])] = &[
    (0, &["geometry"]),
    (1, &["surfel", "frame", "depth-codec"]),
    (2, &["raster", "registration", "place", "pose-graph"]),
    (4, &["slam"]),
    (5, &["wire", "store", "runtime", "encoder", "dataset", "evaluation"]),
    (6, &["agent", "place-recognition", "dpgo", "viewer-gateway"]),
    (7, &["cli", "tests", "xtask"]),
];

/// From this layer on a crate may know network, disk, clock and async runtimes; below it is a function of
/// its inputs.
pub const EDGE_LAYER: u8 = 5;

/// Imports within one layer that are allowed all the same, each with its reason.
pub const SIDEWAYS: &[(&str, &str, &str)] =
    &[("depth-codec", "frame", "the codec packs and unpacks frame's images")];

/// Crates of ours that only the crates listed may import.
pub const GUARDED: &[(&[&str], &[&str], &str)] = &[(
    &["dataset", "evaluation"],
    &["cli", "tests", "xtask"],
    "ground truth must not reach the estimator: built-in worlds come to agents as frames over gRPC",
)];

/// Of the guarded crates, those that the *tests* of other crates may import all the same
/// (`[dev-dependencies]`). A dev-dependency is not handed to the compiler when the library is built, so
/// the estimator cannot name it; and a test of tracking needs a world with a known answer.
/// `evaluation` is not among them: scores are for whole runs.
pub const IN_TESTS: &[&str] = &["dataset"];

/// Outside crates that only the places listed may import, dev-dependencies included: a second user would
/// mean a second place to change when they do.
pub const FENCED: &[(&[&str], &[&str])] = &[
    (&["prost", "prost-types", "prost-build", "tonic-prost", "tonic-prost-build"], &["wire"]),
    // Reading the descriptor set: `wire` makes it, `tests` compares it with the checked-in text.
    (&["prost-reflect", "protox"], &["wire", "tests"]),
    (
        &["tonic", "tonic-health", "tonic-reflection", "tonic-types"],
        &["wire", "runtime", "agent", "place-recognition", "dpgo", "viewer-gateway", "cli", "tests"],
    ),
    (&["ort", "ort-sys"], &["encoder"]),
    (&["wgpu", "naga", "naga_oil"], &["raster"]),
    (&["axum", "utoipa"], &["viewer-gateway"]),
    (&["chitchat", "mdns-sd"], &["runtime", "agent"]),
];

/// Outside crates that nothing below [`EDGE_LAYER`] may import, directly or through others: async
/// runtimes, network, clocks.
pub const EDGE_ONLY: &[&str] = &[
    "tokio",
    "tokio-stream",
    "tokio-util",
    "async-std",
    "smol",
    "futures",
    "hyper",
    "reqwest",
    "tonic",
    "axum",
    "mio",
    "socket2",
    "chrono",
    "time",
    "web-time",
];

/// Paths that no source below [`EDGE_LAYER`] may name outside its tests. A path covers all below it.
pub const EDGE_ONLY_PATHS: &[&str] = &[
    "std::fs",
    "std::net",
    "std::process",
    "std::os",
    "std::time::Instant",
    "std::time::SystemTime",
    "std::time::UNIX_EPOCH",
    "tokio",
    "tonic",
    "reqwest",
];

/// Modules of which [`EDGE_ONLY_PATHS`] names a part: they may not be imported whole, under another name
/// or by a glob, as the rest of their path would then escape the check.
pub const NOT_WHOLE: &[&str] = &["std", "std::time"];

/// Within one crate: a name that only one folder may use. (crate, path, folder below the crate's root)
pub const IN_FOLDER: &[(&str, &str, &str)] = &[("raster", "wgpu", "src/gpu"), ("raster", "naga", "src/gpu")];
