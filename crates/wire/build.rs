//! Compiles `proto/coma/v1` with protox (no system protoc) into Rust, and writes the descriptor set
//! that reflection and the contract lock use.

use prost::Message;
use std::path::{Path, PathBuf};

const FILES: [&str; 6] =
    ["types.proto", "agent.proto", "peer.proto", "place_recognition.proto", "dpgo.proto", "viewer.proto"];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let proto = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../proto");
    println!("cargo:rerun-if-changed={}", proto.join("coma/v1").display());
    let files = FILES.map(|name| format!("coma/v1/{name}"));
    let descriptors = protox::compile(files, [&proto])?;
    tonic_prost_build::configure()
        // Images and surfels are passed on without a copy.
        .bytes(".")
        // Equal messages have equal bytes.
        .btree_map(".")
        .compile_fds(descriptors.clone())?;
    let out = PathBuf::from(std::env::var("OUT_DIR")?).join("coma.descriptors.bin");
    std::fs::write(out, descriptors.encode_to_vec())?;
    Ok(())
}
