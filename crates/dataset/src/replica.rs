//! The layout in which iMAP, NICE-SLAM and MAGiC-SLAM hold Replica and Aria: traj.txt (16 numbers a
//! row, row-major world_from_camera), results/frame*.jpg, results/depth*.png.

use crate::files::{self, FileSequence, FrameFiles};
use crate::{Calibration, DatasetError};
use coma_frame::DepthNoise;
use coma_geometry::{Distortion, Intrinsics, Pose, tum};
use serde::Deserialize;
use std::path::Path;

/// A camera that a data set uses throughout.
pub(crate) struct DatasetCamera {
    camera: Intrinsics,
    depth_units_per_metre: f64,
}

/// Replica and ReplicaMultiagent.
pub(crate) const REPLICA: DatasetCamera = DatasetCamera {
    camera: Intrinsics { width: 1200, height: 680, fx: 600.0, fy: 600.0, cx: 599.5, cy: 339.5 },
    depth_units_per_metre: 6553.5,
};

/// AriaMultiagent, as MAGiC-SLAM prepared it.
pub(crate) const ARIA: DatasetCamera = DatasetCamera {
    camera: Intrinsics { width: 512, height: 512, fx: 280.0, fy: 280.0, cx: 255.5, cy: 255.5 },
    depth_units_per_metre: 6553.5,
};

const FRAMES_PER_SECOND: f64 = 30.0;

/// `cam_params.json` beside or above the sequence.
#[derive(Deserialize)]
struct CameraFile {
    camera: CameraFields,
}

#[derive(Deserialize)]
struct CameraFields {
    w: u32,
    h: u32,
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    scale: f64,
}

/// The camera in `cam_params.json` in the folder or up to two above it, else the data set's.
fn camera(folder: &Path, default: &DatasetCamera) -> Result<(Intrinsics, f64), DatasetError> {
    for above in folder.ancestors().take(3) {
        let path = above.join("cam_params.json");
        let Some(text) = files::read_text_if_present(&path)? else { continue };
        let damaged = |reason: String| DatasetError::damaged(&path, reason);
        let CameraFields { w, h, fx, fy, cx, cy, scale } =
            serde_json::from_str::<CameraFile>(&text).map_err(|e| damaged(e.to_string()))?.camera;
        let camera = Intrinsics { width: w, height: h, fx, fy, cx, cy };
        let camera = camera.validated().map_err(|e| damaged(e.to_string()))?;
        if !(scale.is_finite() && (1.0..=1e6).contains(&scale)) {
            return Err(damaged(format!("scale = {scale} is out of range: 1 to 1e6")));
        }
        return Ok((camera, scale));
    }
    Ok((default.camera, default.depth_units_per_metre))
}

/// True if a folder has this layout.
pub(crate) fn is_sequence(folder: &Path) -> bool {
    folder.join("results").is_dir()
}

pub(crate) fn open(folder: &Path, default: &DatasetCamera) -> Result<FileSequence, DatasetError> {
    let (camera, units) = camera(folder, default)?;
    let results = folder.join("results");
    let colors = files::listed(&results, "frame", &[".jpg", ".jpeg", ".png"])?;
    let depths = files::listed(&results, "depth", &[".png"])?;
    if colors.len() != depths.len() {
        let reason = format!("{} colour frames, but {} depth frames", colors.len(), depths.len());
        return Err(DatasetError::damaged(&results, reason));
    }
    let truth = poses(folder)?;
    if truth.as_ref().is_some_and(|t| t.len() < colors.len()) {
        let reason = format!("{} poses for {} frames", truth.map_or(0, |t| t.len()), colors.len());
        return Err(DatasetError::damaged(&folder.join("traj.txt"), reason));
    }
    let frames = colors.into_iter().zip(depths).enumerate().map(|(i, (color, depth))| {
        let stamp_text = format!("{:.6}", i as f64 / FRAMES_PER_SECOND);
        let stamp = tum::stamp(&stamp_text).expect("a decimal number of seconds");
        // Some sequences have more poses than frames.
        FrameFiles { color, depth, stamp_text, stamp, truth: truth.as_ref().map(|t| t[i]) }
    });
    let calibration = Calibration {
        color: camera,
        depth: camera,
        color_distortion: Distortion::default(),
        depth_distortion: Distortion::default(),
        color_from_depth: Pose::identity(),
        depth_units_per_metre: units,
        depth_min_m: 0.0,
        depth_max_m: 65534.0 / units,
        // Rendered depth: rounding is all that is wrong with it.
        noise: DepthNoise { base_m: 2e-4, quadratic_per_m: 0.0 },
        frames_per_second: FRAMES_PER_SECOND,
    };
    FileSequence::new(folder, calibration, frames.collect())
}

fn poses(folder: &Path) -> Result<Option<Vec<Pose>>, DatasetError> {
    // The trajectory lies in the sequence's folder or, in some multi-agent folders, among its pictures.
    for path in [folder.join("traj.txt"), folder.join("results").join("traj.txt")] {
        let Some(text) = files::read_text_if_present(&path)? else { continue };
        let mut poses = Vec::new();
        for (line, content) in files::lines(&text) {
            let pose = files::numbers(content).and_then(|v| files::pose_from_rows(&v));
            let pose = pose.map_err(|e| DatasetError::damaged(&path, format!("line {line}: {e}")))?;
            poses.push(pose);
        }
        return Ok(Some(poses));
    }
    Ok(None)
}
