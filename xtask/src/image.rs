//! Images FROM scratch: one static program each, no shell, no system library.
//!
//! ONNX Runtime is a shared library, and a static program loads one only together with a second, equal copy
//! of the system's libraries, which a FROM scratch image does not have. So the static images know the builtin
//! place descriptor only, and `--onnxruntime` makes one more, `coma/place-recognition-onnx`, with a
//! dynamic program, ONNX Runtime and the very libraries that both are linked to on this machine.

use crate::steps::{answers, command, timed};
use anyhow::{Context, Result, bail};
use std::path::{Path, PathBuf};
use std::process::Command;

/// What to build.
#[derive(clap::Args)]
pub struct Options {
    /// Only these images, e.g. `agent,viewer-gateway`.
    #[arg(long, value_delimiter = ',')]
    only: Vec<String>,
    /// Build the programs and the folders they go into, but no image.
    #[arg(long)]
    no_docker: bool,
    /// libonnxruntime.so of ONNX Runtime 1.24 or newer, for the image coma/place-recognition-onnx.
    #[arg(long, value_name = "FILE")]
    onnxruntime: Option<PathBuf>,
    /// Tag of every image.
    #[arg(long, default_value = "latest")]
    tag: String,
}

/// An image: `coma/<name>` from `docker/<name>.Dockerfile` around one program.
struct Image {
    name: &'static str,
    package: &'static str,
    program: &'static str,
}

const IMAGES: &[Image] = &[
    Image { name: "agent", package: "coma-agent", program: "coma-agent" },
    Image { name: "place-recognition", package: "coma-place-recognition", program: "coma-place-recognition" },
    Image { name: "dpgo", package: "coma-dpgo", program: "coma-dpgo" },
    Image { name: "viewer-gateway", package: "coma-viewer-gateway", program: "coma-viewer-gateway" },
    Image { name: "coma", package: "coma-cli", program: "coma" },
];

const ONNX: Image = Image {
    name: "place-recognition-onnx",
    package: "coma-place-recognition",
    program: "coma-place-recognition",
};

/// Builds the programs, lays out each image's folder below `target/image`, and builds the images if a
/// Docker daemon answers; if none does, says what to do.
pub fn run(root: &Path, options: &Options) -> Result<()> {
    if let Some(unknown) = options.only.iter().find(|name| !IMAGES.iter().any(|image| image.name == **name)) {
        let names: Vec<_> = IMAGES.iter().map(|image| image.name).collect();
        bail!("--only {unknown}: the images are {}", names.join(", "));
    }
    let wanted: Vec<&Image> = IMAGES
        .iter()
        .filter(|i| options.only.is_empty() || options.only.iter().any(|n| n == i.name))
        .collect();
    let target = host_target()?;
    timed("static programs", || build_static(root, &target, &wanted))?;
    let mut contexts = Vec::new();
    for image in wanted {
        let program = root.join("target/image-build").join(&target).join("release").join(image.program);
        contexts.push((image, lay_out(root, image, &program)?));
    }
    if let Some(library) = &options.onnxruntime {
        let context = timed("dynamic program with ONNX Runtime", || lay_out_onnx(root, library))?;
        contexts.push((&ONNX, context));
    }
    if options.no_docker {
        return Ok(());
    }
    if !answers(&["docker", "info"]) {
        bail!(
            "the programs are in target/image, but no Docker daemon answers, so no image was built. \
             Start one (`systemctl start docker`, or `dockerd` as root) and run this again"
        );
    }
    for (image, context) in contexts {
        let tag = format!("coma/{}:{}", image.name, options.tag);
        let file = root.join("docker").join(format!("{}.Dockerfile", image.name));
        let file = file.to_str().context("the repository's path is not UTF-8")?;
        timed(&tag, || {
            command(&context, &["docker", "build", "--quiet", "--tag", &tag, "--file", file, "."], &[])
        })?;
    }
    Ok(())
}

/// With `--target` given, RUSTFLAGS reach the programs but not the build scripts, which stay dynamic.
fn build_static(root: &Path, target: &str, images: &[&Image]) -> Result<()> {
    let mut line = vec!["cargo", "build", "--release", "--locked", "--target", target];
    line.extend(["--target-dir", "target/image-build", "--bins"]);
    for image in images {
        line.extend(["--package", image.package]);
    }
    // Line tables would be most of an image; the names of functions stay for a readable panic.
    let environment =
        [("RUSTFLAGS", "-C target-feature=+crt-static"), ("CARGO_PROFILE_RELEASE_STRIP", "debuginfo")];
    command(root, &line, &environment)
}

/// The toolchain's own target, as images run on the kind of machine that made them.
fn host_target() -> Result<String> {
    let output = Command::new("rustc").arg("-vV").output().context("starting rustc")?;
    let text = String::from_utf8_lossy(&output.stdout);
    let host =
        text.lines().find_map(|line| line.strip_prefix("host: ")).context("rustc -vV names no host")?;
    if !host.ends_with("-linux-gnu") {
        bail!("images are built on Linux with glibc, not on {host}");
    }
    Ok(host.to_string())
}

/// The folder that becomes the image: the program and an empty data folder (its owner is set by the
/// Dockerfile, and a volume that is mounted there takes it over).
fn lay_out(root: &Path, image: &Image, program: &Path) -> Result<PathBuf> {
    let folder = root.join("target/image").join(image.name);
    if folder.exists() {
        std::fs::remove_dir_all(&folder).with_context(|| format!("clearing {}", folder.display()))?;
    }
    std::fs::create_dir_all(folder.join("data"))?;
    copy(program, &folder.join(image.program))?;
    Ok(folder)
}

/// [`lay_out`], and below `root/` ONNX Runtime and every shared library that it or the program needs, each
/// at the path where the loader looks for it.
fn lay_out_onnx(root: &Path, library: &Path) -> Result<PathBuf> {
    if !library.is_file() {
        bail!("--onnxruntime {}: no such file", library.display());
    }
    command(root, &["cargo", "build", "--release", "--locked", "--bins", "--package", ONNX.package], &[])?;
    let program = root.join("target/release").join(ONNX.program);
    let folder = lay_out(root, &ONNX, &program)?;
    let system = folder.join("root");
    copy(library, &system.join("usr/lib/libonnxruntime.so"))?;
    for linked in [program.as_path(), library] {
        let output = Command::new("ldd").arg(linked).output().context("starting ldd")?;
        for path in shared_libraries(&String::from_utf8_lossy(&output.stdout)) {
            copy(Path::new(path), &system.join(path.trim_start_matches('/')))?;
        }
    }
    Ok(folder)
}

/// The files that `ldd` names.
fn shared_libraries(ldd: &str) -> Vec<&str> {
    ldd.lines().filter_map(|line| line.split_whitespace().find(|word| word.starts_with('/'))).collect()
}

fn copy(from: &Path, to: &Path) -> Result<()> {
    std::fs::create_dir_all(to.parent().context("no folder to copy to")?)?;
    std::fs::copy(from, to).with_context(|| format!("copying {} to {}", from.display(), to.display()))?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_image_has_its_dockerfile_and_package() {
        let root = crate::root();
        let metadata = crate::metadata(&root).unwrap();
        for image in IMAGES.iter().chain([&ONNX]) {
            let path = root.join("docker").join(format!("{}.Dockerfile", image.name));
            let text = std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
            for line in ["FROM scratch", "USER 65532:65532", "VOLUME /data"] {
                assert!(text.lines().any(|l| l == line), "{} lacks {line}", path.display());
            }
            assert!(text.contains(&format!("COPY {0} /{0}", image.program)), "{}", path.display());
            assert!(metadata.packages.iter().any(|p| p.name.as_str() == image.package), "{}", image.package);
        }
    }

    #[test]
    fn the_libraries_that_ldd_names_are_read() {
        let text = "\tlinux-vdso.so.1 (0x1)\n\tlibm.so.6 => /lib/libm.so.6 (0x2)\n\t/lib64/ld-linux-x86-64.so.2 (0x3)\n";
        assert_eq!(shared_libraries(text), ["/lib/libm.so.6", "/lib64/ld-linux-x86-64.so.2"]);
    }
}
