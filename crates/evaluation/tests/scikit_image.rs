//! Agreement with scikit-image on PSNR and SSIM.

use coma_evaluation::{psnr_db, ssim};
use coma_frame::Image;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::path::Path;
use std::process::Command;

const PYTHON: &str = r#"
import sys, numpy as np
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
for w, h, name in zip(sys.argv[1::3], sys.argv[2::3], sys.argv[3::3]):
    a, b = np.fromfile(name, "<f4").reshape(2, int(h), int(w), 3).astype(np.float64)
    s = structural_similarity(a, b, gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
                              data_range=1, channel_axis=2)
    print(repr(float(peak_signal_noise_ratio(a, b, data_range=1))), repr(float(s)))
"#;

fn written(path: &Path, pictures: [&Image<[f32; 3]>; 2]) {
    let values = pictures.into_iter().flat_map(|picture| picture.pixels()).flatten();
    std::fs::write(path, values.flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>()).unwrap();
}

/// A room of flat colours, waves and an edge; and the same, brighter and noisy.
fn pair(width: usize, height: usize, noise: f32, seed: u64) -> [Image<[f32; 3]>; 2] {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let recorded = Image::from_fn(width, height, |x, y| {
        let wave = 0.5 + 0.3 * (0.21 * x as f32).sin() * (0.13 * y as f32).cos();
        let edge = if 3 * x > 2 * y { 0.15 } else { -0.15 };
        std::array::from_fn(|c| (wave + edge * (c as f32 - 0.5)).clamp(0.0, 1.0))
    });
    let mut change = || (random.next_u32() as f32 / u32::MAX as f32 - 0.5) * 2.0 * noise + 0.3 * noise;
    let rendered = recorded.map(|color| color.map(|value| (value + change()).clamp(0.0, 1.0)));
    [rendered, recorded]
}

#[test]
#[ignore = "needs the Python packages evo and scikit-image"]
fn psnr_and_ssim_are_scikit_images() {
    let folder = tempfile::tempdir().unwrap();
    // The last is the smallest that the window fits: its score is a single row.
    let cases = [(160, 120, 0.02), (97, 61, 0.2), (64, 64, 0.6), (40, 11, 0.1)];
    let mut command = Command::new("python3");
    command.args(["-c", PYTHON]);
    let pairs: Vec<_> = cases
        .iter()
        .enumerate()
        .map(|(number, (width, height, noise))| {
            let pictures = pair(*width, *height, *noise, number as u64);
            let path = folder.path().join(format!("{number}.f32"));
            written(&path, [&pictures[0], &pictures[1]]);
            command.args([width.to_string(), height.to_string()]).arg(&path);
            pictures
        })
        .collect();
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).unwrap();
    assert_eq!(text.lines().count(), cases.len());
    for (line, [rendered, recorded]) in text.lines().zip(&pairs) {
        let theirs: Vec<f64> = line.split(' ').map(|word| word.parse().unwrap()).collect();
        let ours = [psnr_db(rendered, recorded).unwrap(), ssim(rendered, recorded).unwrap()];
        println!("{ours:?} {theirs:?}");
        assert!(
            (ours[0] - theirs[0]).abs() < 1e-6 && (ours[1] - theirs[1]).abs() < 1e-9,
            "{ours:?} {theirs:?}"
        );
    }
}
