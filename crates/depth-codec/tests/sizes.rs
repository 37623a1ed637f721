//! Bytes and times on a real sensor's depth.

use coma_depth_codec::{Limits, Quantisation, Settings, decode, decode_u16, encode, encode_u16};
use coma_frame::{DepthNoise, Image};
use std::path::PathBuf;
use std::time::Instant;

/// The shared folder: `COMA_SHARED`, or `shared` beside one of the folders above this crate.
fn shared() -> PathBuf {
    if let Some(folder) = std::env::var_os("COMA_SHARED") {
        return folder.into();
    }
    let start = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    let found = start.ancestors().map(|folder| folder.join("shared")).find(|s| s.join("data").is_dir());
    found.expect("a folder shared/data beside the repository, or COMA_SHARED")
}

fn kitchen_depth() -> Vec<Image<u16>> {
    let folder = shared().join("data/kitchen/depth");
    let mut files: Vec<_> = std::fs::read_dir(&folder).unwrap().map(|e| e.unwrap().path()).collect();
    files.sort();
    let read = |file: &PathBuf| {
        let picture = image::open(file).unwrap().into_luma16();
        Image::from_pixels(picture.width() as usize, picture.height() as usize, picture.into_raw()).unwrap()
    };
    files.iter().step_by(10).map(read).collect()
}

/// What `cv2` PNG level 6 and RVL + Zstd 3 take on the same frames, kB: (16 bit, 12 bit over 10 m).
const PNG_KB: (f64, f64) = (107.0, 88.0);
const RVL_ZSTD_KB: (f64, f64) = (99.0, 77.0);

#[test]
#[ignore = "needs the shared data folder"]
fn real_depth_takes_fewer_bytes_than_png_and_rvl_with_zstd() {
    let frames = kitchen_depth();
    let count = frames.len() as f64;
    let (mut bytes, mut encode_s, mut decode_s) = (0usize, 0.0, 0.0);
    for depth in &frames {
        let start = Instant::now();
        let packed = encode_u16(depth, 1000.0, 3).unwrap();
        encode_s += start.elapsed().as_secs_f64();
        let start = Instant::now();
        let (back, _) = decode_u16(&packed, Limits::default()).unwrap();
        decode_s += start.elapsed().as_secs_f64();
        assert_eq!(&back, depth);
        bytes += packed.len();
    }
    let kb = bytes as f64 / count / 1000.0;
    println!(
        "lossless 16 bit: {kb:.1} kB, encode {:.1} ms, decode {:.1} ms",
        encode_s / count * 1e3,
        decode_s / count * 1e3
    );
    assert!(kb < RVL_ZSTD_KB.0 && kb < PNG_KB.0, "{kb} kB");

    let noise = |fraction| Quantisation::NoiseProportional { noise: DepthNoise::default(), fraction };
    let rows = [
        (
            "12 bit over 10 m",
            Quantisation::Linear12 { near_m: 0.0, far_m: 10.0 },
            RVL_ZSTD_KB.1.min(PNG_KB.1),
        ),
        ("noise, 0.25 sigma", noise(0.25), RVL_ZSTD_KB.0),
        ("noise, 0.5 sigma", noise(0.5), RVL_ZSTD_KB.0),
        ("noise, 1 sigma", noise(1.0), RVL_ZSTD_KB.0),
    ];
    for (name, quantisation, limit_kb) in rows {
        let settings = Settings { quantisation, ..Settings::default() };
        let (mut bytes, mut encode_s, mut decode_s) = (0usize, 0.0, 0.0);
        for depth in &frames {
            let depth_m = depth.map(|units| *units as f32 / 1000.0);
            let start = Instant::now();
            let packed = encode(&depth_m, &settings).unwrap();
            encode_s += start.elapsed().as_secs_f64();
            let start = Instant::now();
            let decoded = decode(&packed, Limits::default()).unwrap();
            decode_s += start.elapsed().as_secs_f64();
            for (z, back) in depth_m.pixels().iter().zip(decoded.depth_m.pixels()) {
                let held = *z == 0.0 && *back == 0.0 || (z - back).abs() <= decoded.max_error.at_m(*z);
                assert!(held || *z > 10.0, "{name}: {z} became {back}");
            }
            bytes += packed.len();
        }
        let kb = bytes as f64 / count / 1000.0;
        println!(
            "{name}: {kb:.1} kB, encode {:.1} ms, decode {:.1} ms",
            encode_s / count * 1e3,
            decode_s / count * 1e3
        );
        assert!(kb < limit_kb, "{name}: {kb} kB, limit {limit_kb}");
    }
}
