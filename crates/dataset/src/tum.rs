//! The layout of the TUM RGB-D benchmark.

use crate::files::{self, FileSequence, FrameFiles, cut};
use crate::{Calibration, DatasetError};
use coma_frame::DepthNoise;
use coma_geometry::{Distortion, Intrinsics, Pose, StampNs, tum};
use std::path::{Path, PathBuf};

/// Colour, depth and ground truth belong together if their stamps differ by at most this (the
/// benchmark's own `associate.py`).
const MAX_DIFFERENCE_NS: i64 = 20_000_000;

/// The benchmark's default camera ("ROS default").
const DEFAULT_CAMERA: Intrinsics =
    Intrinsics { width: 640, height: 480, fx: 525.0, fy: 525.0, cx: 319.5, cy: 239.5 };
const DEFAULT_UNITS_PER_METRE: f64 = 5000.0;

pub(crate) fn open(folder: &Path) -> Result<FileSequence, DatasetError> {
    let (camera, units) = match files::read_text_if_present(&folder.join("calibration.txt"))? {
        Some(text) => calibration(&folder.join("calibration.txt"), &text)?,
        None => (DEFAULT_CAMERA, DEFAULT_UNITS_PER_METRE),
    };
    let associations = folder.join("associations.txt");
    let mut frames = match files::read_text_if_present(&associations)? {
        Some(text) => associated(folder, &associations, &text)?,
        None => matched(folder)?,
    };
    if let Some(text) = files::read_text_if_present(&folder.join("groundtruth.txt"))? {
        let path = folder.join("groundtruth.txt");
        let mut truth = tum::parse(&text).map_err(|e| DatasetError::damaged(&path, e.to_string()))?;
        truth.sort_by_key(|t| t.stamp);
        for frame in &mut frames {
            frame.truth = nearest(&truth, frame.stamp, |t| t.stamp).map(|t| t.pose);
        }
    }
    let calibration = Calibration {
        color: camera,
        depth: camera,
        color_distortion: Distortion::default(),
        depth_distortion: Distortion::default(),
        color_from_depth: Pose::identity(),
        depth_units_per_metre: units,
        depth_min_m: 0.0,
        depth_max_m: 65534.0 / units,
        noise: DepthNoise::default(),
        frames_per_second: rate(&frames),
    };
    FileSequence::new(folder, calibration, frames)
}

/// `width height fx fy cx cy depth_units_per_metre`.
fn calibration(path: &Path, text: &str) -> Result<(Intrinsics, f64), DatasetError> {
    let damaged = |reason: String| DatasetError::damaged(path, reason);
    let joined: Vec<&str> = files::lines(text).map(|(_, line)| line).collect();
    let values = files::numbers(&joined.join(" ")).map_err(damaged)?;
    let [width, height, fx, fy, cx, cy, units] = values[..] else {
        let needed = "width height fx fy cx cy depth_units_per_metre";
        return Err(damaged(format!("{} numbers instead of the 7 of {needed}", values.len())));
    };
    let side = |field: &str, v: f64| {
        if v.fract() == 0.0 && (1.0..=65536.0).contains(&v) {
            return Ok(v as u32);
        }
        Err(damaged(format!("{field} = {v} is no number of pixels")))
    };
    let camera = Intrinsics { width: side("width", width)?, height: side("height", height)?, fx, fy, cx, cy };
    let camera = camera.validated().map_err(|e| damaged(e.to_string()))?;
    if !(units.is_finite() && (1.0..=1e6).contains(&units)) {
        return Err(damaged(format!("depth_units_per_metre = {units} is out of range: 1 to 1e6")));
    }
    Ok((camera, units))
}

/// A path inside the sequence's folder, as its lists name it.
fn inside(folder: &Path, list: &Path, line: usize, name: &str) -> Result<PathBuf, DatasetError> {
    let relative = Path::new(name);
    let plain = relative
        .components()
        .all(|c| matches!(c, std::path::Component::Normal(_) | std::path::Component::CurDir));
    if !plain {
        let reason = format!("line {line}: {:?} does not lie inside the sequence's folder", cut(name));
        return Err(DatasetError::damaged(list, reason));
    }
    Ok(folder.join(relative))
}

fn stamp(list: &Path, line: usize, text: &str) -> Result<StampNs, DatasetError> {
    tum::stamp(text).ok_or_else(|| {
        DatasetError::damaged(list, format!("line {line}: {:?} is no stamp in seconds", cut(text)))
    })
}

fn associated(folder: &Path, list: &Path, text: &str) -> Result<Vec<FrameFiles>, DatasetError> {
    let mut frames = Vec::new();
    for (line, content) in files::lines(text) {
        let words: Vec<&str> = content.split_whitespace().collect();
        let [color_stamp, color, depth_stamp, depth] = words[..] else {
            let needed = "4 words (colour stamp and file, depth stamp and file)";
            let reason = format!("line {line}: {} words instead of {needed}", words.len());
            return Err(DatasetError::damaged(list, reason));
        };
        // Some lists name depth first.
        let depth_first = color.starts_with("depth") && depth.starts_with("rgb");
        let (color_stamp, color, depth) =
            if depth_first { (depth_stamp, depth, color) } else { (color_stamp, color, depth) };
        frames.push(FrameFiles {
            color: inside(folder, list, line, color)?,
            depth: inside(folder, list, line, depth)?,
            stamp_text: color_stamp.to_owned(),
            stamp: stamp(list, line, color_stamp)?,
            truth: None,
        });
    }
    Ok(frames)
}

struct Listed {
    stamp_text: String,
    stamp: StampNs,
    file: PathBuf,
}

fn listed(folder: &Path, name: &str) -> Result<Vec<Listed>, DatasetError> {
    let path = folder.join(name);
    let text = files::read_text(&path)?;
    let mut out = Vec::new();
    for (line, content) in files::lines(&text) {
        let Some((stamp_text, file)) = content.split_once(char::is_whitespace) else {
            return Err(DatasetError::damaged(&path, format!("line {line}: a stamp and a file are needed")));
        };
        out.push(Listed {
            stamp_text: stamp_text.to_owned(),
            stamp: stamp(&path, line, stamp_text)?,
            file: inside(folder, &path, line, file.trim())?,
        });
    }
    out.sort_by_key(|l| l.stamp);
    Ok(out)
}

/// Pairs rgb.txt with depth.txt: the closest pairs first, each picture in one pair, as `associate.py`.
fn matched(folder: &Path) -> Result<Vec<FrameFiles>, DatasetError> {
    let (colors, depths) = (listed(folder, "rgb.txt")?, listed(folder, "depth.txt")?);
    let mut pairs = Vec::new();
    for (i, color) in colors.iter().enumerate() {
        let low = color.stamp.0.saturating_sub(MAX_DIFFERENCE_NS);
        let first = depths.partition_point(|d| d.stamp.0 < low);
        for (j, depth) in depths.iter().enumerate().skip(first) {
            let difference = depth.stamp.0 as i128 - color.stamp.0 as i128;
            if difference > MAX_DIFFERENCE_NS as i128 {
                break;
            }
            pairs.push((difference.abs(), i, j));
        }
    }
    pairs.sort();
    let mut depth_of: Vec<Option<usize>> = vec![None; colors.len()];
    let mut taken = vec![false; depths.len()];
    for (_, i, j) in pairs {
        if depth_of[i].is_none() && !taken[j] {
            depth_of[i] = Some(j);
            taken[j] = true;
        }
    }
    let frames = colors.into_iter().zip(depth_of).filter_map(|(color, depth)| {
        let depth = depths[depth?].file.clone();
        let Listed { stamp_text, stamp, file } = color;
        Some(FrameFiles { color: file, depth, stamp_text, stamp, truth: None })
    });
    Ok(frames.collect())
}

/// The entry of a sorted list nearest to a stamp, if near enough.
fn nearest<T>(sorted: &[T], stamp: StampNs, key: impl Fn(&T) -> StampNs) -> Option<&T> {
    let after = sorted.partition_point(|t| key(t) < stamp);
    let difference = |t: &&T| (key(t).0 as i128 - stamp.0 as i128).abs();
    let best =
        sorted[after.saturating_sub(1)..(after + 1).min(sorted.len())].iter().min_by_key(difference)?;
    (difference(&best) <= MAX_DIFFERENCE_NS as i128).then_some(best)
}

/// Frames per second by the median step, or 30.
fn rate(frames: &[FrameFiles]) -> f64 {
    let mut steps: Vec<i64> = frames.windows(2).map(|w| w[1].stamp.0.saturating_sub(w[0].stamp.0)).collect();
    steps.sort_unstable();
    match steps.get(steps.len() / 2) {
        Some(step) if *step > 0 => 1e9 / *step as f64,
        _ => 30.0,
    }
}
