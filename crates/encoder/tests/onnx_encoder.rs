//! Encoders: what they return, and what is said when something is wrong.
#![cfg(feature = "onnx")]

mod common;

use coma_encoder::{EncoderError, OnnxEncoder, RuntimeSettings, Sha256};
use coma_frame::Image;
use common::{Node, Port, write_model};
use std::path::{Path, PathBuf};
use std::process::Command;

const FREE_IMAGE: &[Option<u64>] = &[None, Some(3), None, None];

/// A model that averages each channel, and its manifest.
fn averaging(folder: &Path, input: &'static [Option<u64>]) -> PathBuf {
    let output = Port("mean", &[None, Some(3), Some(1), Some(1)]);
    write_model(folder, &[Port("image", input)], &[Node("GlobalAveragePool", &["image"], "mean")], output);
    write_manifest(folder, |text| text)
}

fn write_manifest(folder: &Path, change: impl FnOnce(String) -> String) -> PathBuf {
    let text = r#"
model = "model.onnx"
[input]
name = "image"
width = 8
height = 4
mean = [0.0, 0.0, 0.0]
std = [1.0, 0.5, 1.0]
[output]
name = "mean"
dimension = 3
[thresholds]
theta_sim = 0.75
theta_multi = 0.5
"#;
    let path = folder.join("model.toml");
    std::fs::write(&path, change(text.into())).unwrap();
    path
}

fn open(manifest: &Path) -> Result<OnnxEncoder, EncoderError> {
    OnnxEncoder::open(manifest, &RuntimeSettings::default())
}

fn refused(manifest: &Path) -> String {
    match open(manifest) {
        Ok(_) => panic!("the encoder was opened"),
        Err(error) => error.to_string(),
    }
}

#[test]
#[ignore = "needs ONNX Runtime"]
fn the_descriptor_is_the_models_output_at_unit_length() {
    let folder = tempfile::tempdir().unwrap();
    let encoder = open(&averaging(folder.path(), FREE_IMAGE)).unwrap();
    assert_eq!((encoder.dimension(), encoder.thresholds().theta_sim), (3, 0.75));
    let descriptor = encoder.encode(&Image::filled(31, 17, [51, 51, 102])).unwrap();
    // (0.2, 0.2 / 0.5, 0.4), normalised.
    let expected = [1.0 / 3.0, 2.0 / 3.0, 2.0 / 3.0];
    assert!(descriptor.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-5), "{descriptor:?}");
}

#[test]
#[ignore = "needs ONNX Runtime"]
fn an_image_without_pixels_and_a_descriptor_of_zero_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let encoder = open(&averaging(folder.path(), FREE_IMAGE)).unwrap();
    let empty = Image::from_pixels(0, 0, Vec::new()).unwrap();
    assert!(matches!(encoder.encode(&empty), Err(EncoderError::Image { .. })));
    let error = encoder.encode(&Image::filled(8, 4, [0; 3])).unwrap_err().to_string();
    assert!(error.contains("a descriptor of length 0"), "{error}");
}

#[test]
#[ignore = "needs ONNX Runtime"]
fn the_space_follows_model_and_manifest() {
    let folders = [(); 3].map(|()| tempfile::tempdir().unwrap());
    let spaces = folders.each_ref().map(|folder| {
        let manifest = averaging(folder.path(), FREE_IMAGE);
        if folder.path() == folders[2].path() {
            write_manifest(folder.path(), |text| text.replace("width = 8", "width = 16"));
        }
        open(&manifest).unwrap().space()
    });
    assert!(spaces[0].starts_with("onnx/"));
    assert_eq!(spaces[0], spaces[1]);
    assert_ne!(spaces[0], spaces[2]);
}

#[test]
#[ignore = "needs ONNX Runtime"]
fn a_hash_that_fits_is_accepted() {
    let folder = tempfile::tempdir().unwrap();
    averaging(folder.path(), FREE_IMAGE);
    let hash = Sha256::of_file(&folder.path().join("model.onnx")).unwrap().to_string().to_uppercase();
    open(&write_manifest(folder.path(), |text| format!("sha256 = \"{hash}\"{text}"))).unwrap();
}

#[test]
fn another_hash_and_a_missing_model_are_named() {
    let folder = tempfile::tempdir().unwrap();
    averaging(folder.path(), FREE_IMAGE);
    let wrong = "0".repeat(64);
    let error = refused(&write_manifest(folder.path(), |text| format!("sha256 = \"{wrong}\"{text}")));
    assert!(error.contains("model.onnx has SHA-256") && error.contains(&wrong), "{error}");
    let error = refused(&write_manifest(folder.path(), |text| text.replace("model.onnx", "absent.onnx")));
    assert!(error.contains("read ") && error.contains("absent.onnx"), "{error}");
}

#[test]
#[ignore = "needs ONNX Runtime"]
fn wrong_names_and_shapes_are_named_with_those_there_are() {
    let folder = tempfile::tempdir().unwrap();
    averaging(folder.path(), FREE_IMAGE);
    let with =
        |right: &str, wrong: &str| refused(&write_manifest(folder.path(), |text| text.replace(right, wrong)));
    let error = with("name = \"mean\"", "name = \"embedding\"");
    assert!(error.contains("has no output \"embedding\", it has \"mean\""), "{error}");
    let error = with("name = \"image\"", "name = \"pixels\"");
    assert!(error.contains("has no input \"pixels\", it has \"image\""), "{error}");
    let error = with("dimension = 3", "dimension = 4");
    assert!(error.contains("output \"mean\" is [1, 3, 1, 1], expected [1, 4]"), "{error}");
    let error = with("dimension = 3", "dimension = 3\npooling = { kind = \"cls\" }");
    assert!(error.contains("expected [1, tokens, 3]"), "{error}");
    let fixed = tempfile::tempdir().unwrap();
    let error = refused(&averaging(fixed.path(), &[Some(1), Some(3), Some(4), Some(9)]));
    assert!(error.contains("input \"image\" is [1, 3, 4, 9], expected [1, 3, 4, 8]"), "{error}");
}

#[test]
#[ignore = "needs ONNX Runtime"]
fn a_file_that_is_no_model_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let manifest = averaging(folder.path(), FREE_IMAGE);
    for content in [&b"not a model"[..], b"", &[0xff; 200]] {
        std::fs::write(folder.path().join("model.onnx"), content).unwrap();
        let error = refused(&manifest);
        assert!(error.contains("model.onnx"), "{error}");
    }
}

#[test]
#[ignore = "needs ONNX Runtime"]
fn threads_may_share_an_encoder() {
    let folder = tempfile::tempdir().unwrap();
    let encoder = open(&averaging(folder.path(), FREE_IMAGE)).unwrap();
    let image = Image::filled(9, 9, [10, 20, 30]);
    let expected = encoder.encode(&image).unwrap();
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| (0..20).for_each(|_| assert_eq!(encoder.encode(&image).unwrap(), expected)));
        }
    });
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

/// Prints the resized pictures' bytes as numbers, then the unit embeddings, one picture a line.
const PYTHON: &str = r#"
import sys, cv2, numpy as np, onnxruntime as ort
s = ort.InferenceSession(sys.argv[1], providers=["CPUExecutionProvider"])
for f in sys.argv[2:]:
    im = cv2.cvtColor(cv2.imread(f, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    r = cv2.resize(im, (224, 224), interpolation=cv2.INTER_AREA)
    x = ((r.astype("f") / 255 - np.array([.485, .456, .406], "f")) / np.array([.229, .224, .225], "f")).transpose(2, 0, 1)[None].astype("f")
    e = s.run(["embedding"], {s.get_inputs()[0].name: x})[0][0]
    print(" ".join(map(str, r.ravel())))
    print(" ".join(repr(float(v)) for v in e / np.linalg.norm(e)))
"#;

#[test]
#[ignore = "needs the shared data folder, and Python with onnxruntime and cv2"]
fn the_embedding_is_that_of_pythons_onnxruntime() {
    let model = shared().join("models/dinov2s14_block8_gem_224.onnx");
    let folder = tempfile::tempdir().unwrap();
    let manifest = write_manifest(folder.path(), |text| {
        text.replace("model.onnx", model.to_str().unwrap())
            .replace("\"image\"", "\"pixel_values\"")
            .replace("width = 8", "width = 224")
            .replace("height = 4", "height = 224")
            .replace("[0.0, 0.0, 0.0]", "[0.485, 0.456, 0.406]")
            .replace("[1.0, 0.5, 1.0]", "[0.229, 0.224, 0.225]")
            .replace("\"mean\"", "\"embedding\"")
            .replace("dimension = 3", "dimension = 384")
    });
    let encoder = open(&manifest).unwrap();
    let mut pictures: Vec<_> = std::fs::read_dir(shared().join("data/kitchen/rgb"))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .collect();
    pictures.sort();
    // Lossless copies, so that both sides decode the same pixels.
    let pictures: Vec<(PathBuf, Image<[u8; 3]>)> = pictures
        .iter()
        .step_by(130)
        .enumerate()
        .map(|(k, path)| {
            let picture = image::open(path).unwrap().into_rgb8();
            let copy = folder.path().join(format!("{k}.png"));
            picture.save(&copy).unwrap();
            let pixels = picture.pixels().map(|pixel| pixel.0).collect();
            (copy, Image::from_pixels(picture.width() as usize, picture.height() as usize, pixels).unwrap())
        })
        .collect();
    let output = Command::new("python3")
        .arg("-c")
        .arg(PYTHON)
        .arg(&model)
        .args(pictures.iter().map(|(path, _)| path))
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).unwrap();
    let mut lines =
        text.lines().map(|line| line.split(' ').map(|v| v.parse::<f64>().unwrap()).collect::<Vec<_>>());
    for (path, picture) in &pictures {
        let resized = coma_encoder::resize_area(picture, 224, 224);
        let theirs = lines.next().unwrap();
        let ours: Vec<f64> = resized.pixels().iter().flatten().map(|v| *v as f64).collect();
        let different = ours.iter().zip(&theirs).filter(|(a, b)| a != b).count();
        let largest = ours.iter().zip(&theirs).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(
            largest <= 1.0 && different < ours.len() / 1000,
            "{path:?}: {different} bytes differ, by up to {largest}"
        );
        let start = std::time::Instant::now();
        let ours = encoder.encode(picture).unwrap();
        let took = start.elapsed();
        let theirs = lines.next().unwrap();
        let error = ours.iter().zip(&theirs).map(|(a, b)| (*a as f64 - b).abs()).fold(0.0, f64::max);
        println!("{different} bytes of the resized picture differ, embedding by {error:.1e}, {took:?}");
        assert!(ours.len() == theirs.len() && error < 1e-4, "{path:?}: {error}");
    }
}
