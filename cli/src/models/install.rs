//! A model is fetched, checked by its hash, tried, and put into the folder with its manifest.

use super::folder::{self, Folder};
use super::{In, recommended, tried};
use anyhow::{Context, bail, ensure};
use clap::Args;
use coma_encoder::{EncoderError, Manifest, RuntimeSettings};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Largest model, bytes: that of an ONNX file in one piece.
const MAX_BYTES: u64 = 2 << 30;

/// Installs a model (ONNX) from a file or an address.
///
/// Without --manifest it is taken for the recommended one, DINOv2 ViT-S/14, as common exports have it:
///
///   coma models install https://huggingface.co/onnx-community/dinov2-small/resolve/main/onnx/model.onnx
///   coma models install encoder.onnx --manifest encoder.toml
///
/// Addresses are fetched by the program curl, which knows the system's certificates and proxies.
#[derive(Args)]
pub struct Arguments {
    /// A file, or an http(s) address.
    source: String,
    /// What has to be known of the model (TOML): input, output, pooling, thresholds.
    #[arg(long, value_name = "MANIFEST.toml")]
    manifest: Option<PathBuf>,
    /// Its name; default: the manifest's.
    #[arg(long)]
    name: Option<String>,
    /// Another file than that of this SHA-256 (64 hexadecimal digits) is refused.
    #[arg(long)]
    sha256: Option<String>,
    /// Replaces a model of the same name.
    #[arg(long)]
    replace: bool,
    #[command(flatten)]
    within: In,
}

/// Runs it.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let folder = Folder::open(arguments.within.dir.as_deref())?;
    let (manifest, text) = install(arguments, &folder)?;
    println!("{text}");
    match tried(&manifest, &RuntimeSettings::default()) {
        Ok(text) => println!("{text}"),
        Err(error) if matches!(error.downcast_ref(), Some(EncoderError::NoRuntime { .. })) => {
            println!("not tried: {error}");
        }
        Err(error) => {
            return Err(error.context(format!(
                "the model is installed but can't be used as {} says",
                manifest.display()
            )));
        }
    }
    println!("to use it, write into the settings of place recognition (--place-config of `coma run`):");
    println!("models = [{:?}]", manifest.display().to_string());
    Ok(())
}

/// Puts model and manifest into the folder; the manifest's path, and what was done.
fn install(arguments: &Arguments, folder: &Folder) -> anyhow::Result<(PathBuf, String)> {
    let (mut manifest, own_name) = match &arguments.manifest {
        Some(path) => (Manifest::load(path)?, folder::name_of(path)),
        None => (recommended::manifest(), recommended::NAME.to_owned()),
    };
    let name = folder::checked(arguments.name.as_deref().unwrap_or(&own_name))?;
    if let Some(hash) = &arguments.sha256 {
        manifest.sha256 = Some(hash.clone());
    }
    manifest.model = format!("{name}.onnx").into();
    manifest.check(arguments.manifest.as_deref().unwrap_or(Path::new("--sha256")))?;
    let path = folder.path().join(format!("{name}.toml"));
    let model = folder.path().join(&manifest.model);
    if !arguments.replace {
        ensure!(!path.exists() && !model.exists(), "{name} is installed already: --replace replaces it");
    }
    std::fs::create_dir_all(folder.path()).with_context(|| folder.path().display().to_string())?;
    // Removed unless it is kept at the end.
    let part = Part(folder.path().join(format!(".{name}.onnx.part")));
    fetch(&arguments.source, &part.0)?;
    let expected = manifest.sha256.is_some();
    let hash = manifest.verify_file(&part.0).map_err(|error| match error {
        EncoderError::Hash { found, expected, .. } => {
            anyhow::anyhow!(
                "{} has SHA-256 {found}, expected {expected}: it is not installed",
                arguments.source
            )
        }
        other => other.into(),
    })?;
    manifest.sha256 = Some(hash.to_string());
    // The manifest comes last: it never names a model that is not there.
    std::fs::rename(&part.0, &model).with_context(|| model.display().to_string())?;
    crate::run::write_atomically(&path, toml::to_string(&manifest)?.as_bytes())?;
    let said = if expected { "as expected" } else { "which nobody stated before: compare it" };
    Ok((path, format!("{name} installed: {}\nSHA-256 {hash}, {said}", model.display())))
}

/// A file that is not yet whole.
struct Part(PathBuf);

impl Drop for Part {
    fn drop(&mut self) {
        // Gone already if it was kept.
        let _ = std::fs::remove_file(&self.0);
    }
}

fn fetch(source: &str, into: &Path) -> anyhow::Result<()> {
    if source.starts_with("http://") || source.starts_with("https://") {
        return download(source, into);
    }
    let source = Path::new(source.strip_prefix("file://").unwrap_or(source));
    let shown = || source.display().to_string();
    let from = std::fs::File::open(source).with_context(shown)?;
    let mut to = std::fs::File::create(into).with_context(|| into.display().to_string())?;
    let copied = std::io::copy(&mut from.take(MAX_BYTES + 1), &mut to).with_context(shown)?;
    ensure!(copied <= MAX_BYTES, "{} is larger than {MAX_BYTES} bytes", shown());
    to.flush().with_context(|| into.display().to_string())
}

fn download(url: &str, into: &Path) -> anyhow::Result<()> {
    let max = MAX_BYTES.to_string();
    let mut curl = Command::new("curl");
    curl.args(["--fail", "--location", "--show-error", "--progress-bar", "--proto", "=http,https"])
        .args(["--proto-redir", "=https", "--max-filesize", &max, "--connect-timeout", "30", "--output"])
        .arg(into)
        .args(["--", url])
        .stdin(Stdio::null());
    match curl.status() {
        Ok(status) if status.success() => {}
        Ok(status) => bail!("{url} could not be fetched: curl ended with {status}"),
        Err(error) => {
            bail!("curl could not be run ({error}): fetch {url} by other means, and install the file")
        }
    }
    let length = std::fs::metadata(into).with_context(|| into.display().to_string())?.len();
    ensure!(length <= MAX_BYTES, "{url} is larger than {MAX_BYTES} bytes");
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_encoder::Sha256;
    use std::net::TcpListener;

    fn arguments(source: &str) -> Arguments {
        let within = In { dir: None };
        Arguments { source: source.into(), manifest: None, name: None, sha256: None, replace: false, within }
    }

    #[test]
    fn a_file_is_installed_with_a_manifest_that_states_its_hash() {
        let place = tempfile::tempdir().unwrap();
        let (file, folder) =
            (place.path().join("m.onnx"), Folder::open(Some(&place.path().join("in"))).unwrap());
        std::fs::write(&file, "weights").unwrap();
        let source = file.display().to_string();
        let (path, said) = install(&arguments(&source), &folder).unwrap();
        let manifest = Manifest::load(&path).unwrap();
        let hash = Sha256::of_file(&file).unwrap().to_string();
        assert_eq!(
            (manifest.sha256.as_ref(), folder::name_of(&path).as_str()),
            (Some(&hash), recommended::NAME)
        );
        assert!(said.contains(&hash) && said.contains("nobody stated"), "{said}");
        assert_eq!(std::fs::read(path.with_file_name(&manifest.model)).unwrap(), b"weights");
        let again = install(&arguments(&source), &folder).unwrap_err().to_string();
        assert!(again.contains("--replace"), "{again}");
        install(&Arguments { replace: true, sha256: Some(hash), ..arguments(&source) }, &folder).unwrap();
        assert_eq!(folder.manifests().unwrap(), [path]);
    }

    #[test]
    fn another_hash_and_a_missing_file_leave_nothing_behind() {
        let place = tempfile::tempdir().unwrap();
        let (file, folder) =
            (place.path().join("m.onnx"), Folder::open(Some(&place.path().join("in"))).unwrap());
        std::fs::write(&file, "weights").unwrap();
        let source = file.display().to_string();
        let wrong = Arguments { sha256: Some("0".repeat(64)), ..arguments(&source) };
        let error = install(&wrong, &folder).unwrap_err().to_string();
        assert!(error.contains(&"0".repeat(64)) && error.contains("not installed"), "{error}");
        let no_hash = Arguments { sha256: Some("12".into()), ..arguments(&source) };
        assert!(install(&no_hash, &folder).unwrap_err().to_string().contains("sha256 is \"12\""));
        let error = format!("{:#}", install(&arguments("/nowhere.onnx"), &folder).unwrap_err());
        assert!(error.contains("/nowhere.onnx"), "{error}");
        let left = std::fs::read_dir(folder.path()).unwrap().count();
        assert_eq!(left, 0);
    }

    #[test]
    fn an_address_is_fetched_and_a_refusal_is_told() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        let server = std::thread::spawn(move || {
            for answer in ["HTTP/1.1 200 OK\r\nContent-Length: 7\r\n\r\nweights", "HTTP/1.1 404 No\r\n\r\n"] {
                let (mut stream, _) = listener.accept().unwrap();
                let mut request = [0u8; 4096];
                assert!(stream.read(&mut request).unwrap() > 0);
                stream.write_all(answer.as_bytes()).unwrap();
            }
        });
        let place = tempfile::tempdir().unwrap();
        let folder = Folder::open(Some(place.path())).unwrap();
        let (path, _) = install(&arguments(&format!("{url}/m.onnx")), &folder).unwrap();
        assert_eq!(std::fs::read(path.with_extension("onnx")).unwrap(), b"weights");
        let gone = Arguments { name: Some("other".into()), ..arguments(&format!("{url}/gone")) };
        let error = install(&gone, &folder).unwrap_err().to_string();
        assert!(error.contains("/gone could not be fetched"), "{error}");
        server.join().unwrap();
    }
}
