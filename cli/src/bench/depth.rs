//! `coma bench depth`: what depth costs to send, and what it loses on the way.

use super::cpu::timed;
use crate::source;
use clap::Args;
use coma_dataset::sequence::{RawFrame, rgbd_frame};
use coma_depth_codec::{ErrorBound, Limits, Quantisation, Settings, decode, encode};
use coma_frame::{DepthNoise, Image};
use serde::Serialize;
use std::fmt::Write as _;

/// Encodes a sequence's depth in every way that the codec knows: bytes per frame, the error that it promises and the
/// one that was found, processor time.
#[derive(Args)]
pub struct Arguments {
    /// Sequences, as for `coma run`.
    #[arg(required = true)]
    specs: Vec<String>,
    /// Takes every K-th frame.
    #[arg(long, value_name = "K", default_value_t = 10)]
    every: usize,
    /// Zstd's level, 1 to 19.
    #[arg(long, default_value_t = 3)]
    level: i32,
    /// Prints JSON instead of a table.
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Row {
    spec: String,
    name: &'static str,
    frames: usize,
    /// As they lie on disk; none where they are made on demand.
    stored_kb: Option<f64>,
    kb: f64,
    bits_per_pixel: f64,
    /// Promised at 1 m and 4 m, millimetres.
    bound_mm: [f64; 2],
    /// The largest found, millimetres, and as a share of the promise at its own depth.
    error_mm: f64,
    error_of_bound: f64,
    /// Pixels that lost their measurement, of those that had one.
    lost: f64,
    encode_ms: f64,
    decode_ms: f64,
}

/// Runs it.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let mut rows = Vec::new();
    for source in source::open(&arguments.specs)? {
        let sequence = &*source.sequence;
        let calibration = sequence.calibration();
        let indices: Vec<usize> = (0..sequence.len()).step_by(arguments.every.max(1)).collect();
        let mut frames = Vec::new();
        let (mut stored, mut is_stored) = (0usize, true);
        for index in &indices {
            let raw = sequence.frame(*index)?;
            match stored_bytes(&raw) {
                Some(bytes) => stored += bytes,
                None => is_stored = false,
            }
            frames.push(rgbd_frame(sequence, *index)?.depth_m);
        }
        let stored_kb = is_stored.then(|| stored as f64 / indices.len() as f64 / 1e3);
        for (name, quantisation) in ways(calibration.depth_units_per_metre as f32, calibration.noise) {
            let settings = Settings { quantisation, zstd_level: arguments.level };
            let mut row = measure(&frames, &settings)?;
            row.name = name;
            row.spec = source.spec.clone();
            row.stored_kb = stored_kb;
            rows.push(row);
        }
    }
    if arguments.json {
        println!("{}", serde_json::to_string_pretty(&rows)?);
    } else {
        print!("{}", table(&rows));
    }
    Ok(())
}

fn stored_bytes(raw: &RawFrame) -> Option<usize> {
    match &raw.depth {
        coma_dataset::sequence::DepthBytes::Png16(bytes) => Some(bytes.len()),
        coma_dataset::sequence::DepthBytes::Raw16(_) => None,
    }
}

fn ways(units_per_metre: f32, noise: DepthNoise) -> [(&'static str, Quantisation); 5] {
    let of_noise = |fraction| Quantisation::NoiseProportional { noise, fraction };
    [
        ("the sensor's units", Quantisation::Lossless16 { units_per_metre }),
        ("12 bits over 10 m", Quantisation::Linear12 { near_m: 0.0, far_m: 10.0 }),
        ("a quarter of the noise", of_noise(0.25)),
        ("half of the noise", of_noise(0.5)),
        ("all of the noise", of_noise(1.0)),
    ]
}

fn measure(frames: &[Image<f32>], settings: &Settings) -> anyhow::Result<Row> {
    let (mut bytes, mut pixels, mut measured, mut lost) = (0usize, 0usize, 0usize, 0usize);
    let (mut encode_ms, mut decode_ms, mut error_m, mut error_of_bound) = (0.0, 0.0, 0.0f32, 0.0f32);
    let mut bound = ErrorBound::Uniform { max_m: 0.0 };
    for depth_m in frames {
        let (packed, ms) = timed(|| encode(depth_m, settings));
        let packed = packed?;
        encode_ms += ms;
        let (decoded, ms) = timed(|| decode(&packed, Limits::default()));
        let decoded = decoded?;
        decode_ms += ms;
        bytes += packed.len();
        pixels += depth_m.pixels().len();
        bound = decoded.max_error;
        for (z, back) in depth_m.pixels().iter().zip(decoded.depth_m.pixels()).filter(|(z, _)| **z > 0.0) {
            measured += 1;
            if *back == 0.0 {
                lost += 1;
                continue;
            }
            let error = (z - back).abs();
            error_m = error_m.max(error);
            error_of_bound = error_of_bound.max(error / bound.at_m(*z));
        }
    }
    let count = frames.len() as f64;
    Ok(Row {
        spec: String::new(),
        name: "",
        frames: frames.len(),
        stored_kb: None,
        kb: bytes as f64 / count / 1e3,
        bits_per_pixel: bytes as f64 * 8.0 / pixels as f64,
        bound_mm: [1.0, 4.0].map(|z| bound.at_m(z) as f64 * 1e3),
        error_mm: error_m as f64 * 1e3,
        error_of_bound: error_of_bound as f64,
        lost: lost as f64 / measured.max(1) as f64,
        encode_ms: encode_ms / count,
        decode_ms: decode_ms / count,
    })
}

fn table(rows: &[Row]) -> String {
    let mut out = String::from(
        "| sequence | steps | frames | kB stored | kB | bits per pixel | bound mm at 1 m, 4 m | largest error mm | of bound | \
         lost % | encode CPU ms | decode CPU ms |\n|---|---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    for r in rows {
        let stored = r.stored_kb.map_or("-".into(), |kb| format!("{kb:.1}"));
        let _ = writeln!(
            out,
            "| {} | {} | {} | {stored} | {:.1} | {:.2} | {:.2}, {:.2} | {:.2} | {:.2} | {:.2} | {:.1} | {:.1} |",
            r.spec,
            r.name,
            r.frames,
            r.kb,
            r.bits_per_pixel,
            r.bound_mm[0],
            r.bound_mm[1],
            r.error_mm,
            r.error_of_bound,
            100.0 * r.lost,
            r.encode_ms,
            r.decode_ms
        );
    }
    out
}
