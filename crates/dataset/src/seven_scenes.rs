//! The layout of Microsoft's 7-Scenes: frame-XXXXXX.color.png, .depth.png (millimetres, 65535 = none),
//! .pose.txt (4x4, world_from_camera).

use crate::files::{self, FileSequence, FrameFiles};
use crate::{Calibration, DatasetError};
use coma_frame::DepthNoise;
use coma_geometry::{Distortion, Intrinsics, Pose, tum};
use std::path::Path;

/// The data set's published camera; colour and depth are used as if registered, as is usual.
const CAMERA: Intrinsics = Intrinsics { width: 640, height: 480, fx: 585.0, fy: 585.0, cx: 320.0, cy: 240.0 };
const FRAMES_PER_SECOND: f64 = 30.0;

pub(crate) fn open(folder: &Path) -> Result<FileSequence, DatasetError> {
    let mut frames = Vec::new();
    for color in files::listed(folder, "frame-", &[".color.png"])? {
        let name = color.file_name().map_or(String::new(), |n| n.to_string_lossy().into_owned());
        let stem = name.trim_end_matches(".color.png");
        let number: u32 = stem.trim_start_matches("frame-").parse().map_err(|_| {
            DatasetError::damaged(&color, "the name has no frame number (frame-XXXXXX.color.png)")
        })?;
        let path = folder.join(format!("{stem}.pose.txt"));
        let truth = match files::read_text_if_present(&path)? {
            Some(text) => {
                let pose = files::numbers(&text).and_then(|v| files::pose_from_rows(&v));
                Some(pose.map_err(|e| DatasetError::damaged(&path, e))?)
            }
            None => None,
        };
        let stamp_text = format!("{:.6}", number as f64 / FRAMES_PER_SECOND);
        let stamp = tum::stamp(&stamp_text).expect("a decimal number of seconds");
        let depth = folder.join(format!("{stem}.depth.png"));
        frames.push(FrameFiles { color, depth, stamp_text, stamp, truth });
    }
    let calibration = Calibration {
        color: CAMERA,
        depth: CAMERA,
        color_distortion: Distortion::default(),
        depth_distortion: Distortion::default(),
        color_from_depth: Pose::identity(),
        depth_units_per_metre: 1000.0,
        depth_min_m: 0.0,
        depth_max_m: 65.534,
        noise: DepthNoise::default(),
        frames_per_second: FRAMES_PER_SECOND,
    };
    FileSequence::new(folder, calibration, frames)
}
