//! The page's files are read while the crate is compiled: compile again when they change.

fn main() {
    println!("cargo::rerun-if-changed=../../web/viewer/dist");
    println!("cargo::rerun-if-changed=build.rs");
}
