//! The perceptual distance: what goes in, what comes out.
#![cfg(feature = "onnx")]

mod common;

use coma_encoder::{EncoderError, Perceptual, RuntimeSettings};
use coma_frame::Image;
use common::{Node, Port, write_model};
use std::path::{Path, PathBuf};

const FREE_IMAGE: &[Option<u64>] = &[Some(1), Some(3), None, None];

/// The mean absolute difference of its two images.
fn mean_difference(folder: &Path, input: &'static [Option<u64>]) -> PathBuf {
    let nodes =
        [Node("Sub", &["a", "b"], "d"), Node("Abs", &["d"], "e"), Node("ReduceMean", &["e"], "distance")];
    write_model(
        folder,
        &[Port("a", input), Port("b", input)],
        &nodes,
        Port("distance", &[None, None, None, None]),
    )
}

fn open(path: &Path) -> Result<Perceptual, EncoderError> {
    Perceptual::open(path, &RuntimeSettings::default())
}

fn refused(path: &Path) -> String {
    match open(path) {
        Ok(_) => panic!("the model was opened"),
        Err(error) => error.to_string(),
    }
}

#[test]
#[ignore = "needs ONNX Runtime"]
fn images_reach_the_model_between_minus_one_and_one() {
    let folder = tempfile::tempdir().unwrap();
    let model = open(&mean_difference(folder.path(), FREE_IMAGE)).unwrap();
    let grey = |v: f32| Image::filled(20, 12, [v, v, v]);
    let distance = |a: f32, b: f32| model.distance(&grey(a), &grey(b)).unwrap();
    assert_eq!(distance(0.3, 0.3), 0.0);
    assert!((distance(0.0, 1.0) - 2.0).abs() < 1e-6, "black is -1, white is 1");
    assert!((distance(0.25, 0.5) - 0.5).abs() < 1e-6);
    assert!((distance(-3.0, 7.0) - 2.0).abs() < 1e-6, "clamped");
    let other_size = Image::filled(12, 20, [0.0; 3]);
    assert!(matches!(model.distance(&grey(0.0), &other_size), Err(EncoderError::Image { .. })));
}

#[test]
#[ignore = "needs ONNX Runtime"]
fn a_model_of_one_size_refuses_another() {
    let folder = tempfile::tempdir().unwrap();
    let model = open(&mean_difference(folder.path(), &[Some(1), Some(3), Some(16), Some(24)])).unwrap();
    let image = |width, height| Image::filled(width, height, [0.5; 3]);
    assert_eq!(model.distance(&image(24, 16), &image(24, 16)).unwrap(), 0.0);
    let error = model.distance(&image(16, 24), &image(16, 24)).unwrap_err().to_string();
    assert!(error.contains("the images' size is [1, 3, 24, 16], expected [1, 3, 16, 24]"), "{error}");
}

#[test]
#[ignore = "needs ONNX Runtime"]
fn a_model_that_gives_no_distance_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let one = write_model(
        folder.path(),
        &[Port("a", FREE_IMAGE)],
        &[Node("Abs", &["a"], "e")],
        Port("e", FREE_IMAGE),
    );
    assert!(refused(&one).contains("the number of inputs is 1, expected 2"));
    let map = write_model(
        folder.path(),
        &[Port("a", FREE_IMAGE), Port("b", FREE_IMAGE)],
        &[Node("Sub", &["a", "b"], "d")],
        Port("d", FREE_IMAGE),
    );
    let image = Image::filled(4, 4, [0.5; 3]);
    let error = open(&map).unwrap().distance(&image, &image).unwrap_err().to_string();
    assert!(error.contains("a tensor of shape [1, 3, 4, 4], expected one finite number"), "{error}");
    let vectors = write_model(
        folder.path(),
        &[Port("a", &[None, Some(8)]), Port("b", &[None, Some(8)])],
        &[Node("Sub", &["a", "b"], "d")],
        Port("d", &[None, Some(8)]),
    );
    assert!(refused(&vectors).contains("input \"a\" is [?, 8], expected [1, 3, height, width]"));
}

#[test]
fn a_missing_file_is_named() {
    assert!(refused(Path::new("/nowhere/lpips.onnx")).contains("read /nowhere/lpips.onnx"));
}
