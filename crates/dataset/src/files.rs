//! Reading files with limits and errors that name them, and sequences made of picture files.

use crate::{Calibration, ColorBytes, DatasetError, DepthBytes, RawFrame, Sequence};
use coma_geometry::{Pose, StampNs};
use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};

/// Largest file that is read, bytes.
const MAX_FILE_BYTES: u64 = 256 << 20;

pub(crate) fn read(path: &Path) -> Result<Vec<u8>, DatasetError> {
    let file = fs::File::open(path).map_err(|e| DatasetError::io(path, e))?;
    let mut bytes = Vec::new();
    file.take(MAX_FILE_BYTES + 1).read_to_end(&mut bytes).map_err(|e| DatasetError::io(path, e))?;
    if bytes.len() as u64 > MAX_FILE_BYTES {
        return Err(DatasetError::damaged(path, format!("larger than {MAX_FILE_BYTES} bytes")));
    }
    Ok(bytes)
}

pub(crate) fn read_text(path: &Path) -> Result<String, DatasetError> {
    String::from_utf8(read(path)?).map_err(|_| DatasetError::damaged(path, "is not UTF-8 text"))
}

/// The text of a file that may be missing.
pub(crate) fn read_text_if_present(path: &Path) -> Result<Option<String>, DatasetError> {
    match path.try_exists() {
        Ok(false) => Ok(None),
        Ok(true) => read_text(path).map(Some),
        Err(e) => Err(DatasetError::io(path, e)),
    }
}

/// The lines of a text without comments and blank ones, numbered from 1.
pub(crate) fn lines(text: &str) -> impl Iterator<Item = (usize, &str)> {
    text.lines()
        .enumerate()
        .map(|(i, line)| (i + 1, line.split('#').next().unwrap_or("").trim()))
        .filter(|(_, line)| !line.is_empty())
}

/// Files of a folder whose names start and end so, sorted by name.
pub(crate) fn listed(folder: &Path, start: &str, ends: &[&str]) -> Result<Vec<PathBuf>, DatasetError> {
    let mut out = Vec::new();
    for entry in fs::read_dir(folder).map_err(|e| DatasetError::io(folder, e))? {
        let path = entry.map_err(|e| DatasetError::io(folder, e))?.path();
        let name = path.file_name().map_or(String::new(), |n| n.to_string_lossy().into_owned());
        if name.starts_with(start) && ends.iter().any(|end| name.ends_with(end)) {
            out.push(path);
        }
    }
    out.sort();
    Ok(out)
}

/// A 4x4 row-major `world_from_camera`.
pub(crate) fn pose_from_rows(values: &[f64]) -> Result<Pose, String> {
    if values.len() != 16 {
        return Err(format!("{} numbers instead of the 16 of a 4x4 pose", values.len()));
    }
    if !values.iter().all(|v| v.is_finite()) {
        return Err("a pose with a number that is not finite".into());
    }
    let matrix = nalgebra::Matrix4::from_row_slice(values);
    let linear = matrix.fixed_view::<3, 3>(0, 0).into_owned();
    let drift = (linear * linear.transpose() - nalgebra::Matrix3::identity()).norm();
    if drift > 0.05 || linear.determinant() < 0.0 {
        return Err(format!("a pose whose rotation is none (off by {drift:.3})"));
    }
    let rotation = nalgebra::UnitQuaternion::from_matrix(&linear);
    Ok(Pose::from_parts(matrix.fixed_view::<3, 1>(0, 3).into_owned().into(), rotation))
}

pub(crate) fn numbers(text: &str) -> Result<Vec<f64>, String> {
    text.split_whitespace()
        .map(|word| word.parse().map_err(|_| format!("{:?} is no number", cut(word))))
        .collect()
}

/// At most 60 characters, for error messages.
pub(crate) fn cut(text: &str) -> String {
    text.chars().take(60).collect()
}

/// One frame's files.
#[derive(Clone, Debug)]
pub(crate) struct FrameFiles {
    pub color: PathBuf,
    pub depth: PathBuf,
    pub stamp_text: String,
    pub stamp: StampNs,
    pub truth: Option<Pose>,
}

/// A sequence of picture files.
#[derive(Clone, Debug)]
pub(crate) struct FileSequence {
    pub calibration: Calibration,
    pub frames: Vec<FrameFiles>,
}

impl FileSequence {
    /// Refuses a sequence without frames, naming `folder`.
    pub(crate) fn new(
        folder: &Path,
        calibration: Calibration,
        frames: Vec<FrameFiles>,
    ) -> Result<Self, DatasetError> {
        if frames.is_empty() {
            return Err(DatasetError::damaged(folder, "holds no frames with colour and depth"));
        }
        Ok(FileSequence { calibration, frames })
    }
}

impl Sequence for FileSequence {
    fn calibration(&self) -> &Calibration {
        &self.calibration
    }

    fn len(&self) -> usize {
        self.frames.len()
    }

    fn stamp_text(&self, index: usize) -> &str {
        &self.frames[index].stamp_text
    }

    fn stamp(&self, index: usize) -> StampNs {
        self.frames[index].stamp
    }

    fn frame(&self, index: usize) -> Result<RawFrame, DatasetError> {
        let files = self.frames.get(index).ok_or(DatasetError::NoSuchFrame { index, len: self.len() })?;
        let color = read(&files.color)?;
        let color = if color.starts_with(b"\x89PNG") {
            ColorBytes::Png(color)
        } else if color.starts_with(b"\xff\xd8") {
            ColorBytes::Jpeg(color)
        } else {
            return Err(DatasetError::damaged(&files.color, "is neither PNG nor JPEG"));
        };
        let depth = read(&files.depth)?;
        if !depth.starts_with(b"\x89PNG") {
            return Err(DatasetError::damaged(&files.depth, "is not PNG"));
        }
        let frame = RawFrame { color, depth: DepthBytes::Png16(depth) };
        frame.check(&self.calibration).map_err(|e| match e {
            DatasetError::Picture { field: "depth", reason } => DatasetError::damaged(&files.depth, reason),
            DatasetError::Picture { reason, .. } => DatasetError::damaged(&files.color, reason),
            other => other,
        })?;
        Ok(frame)
    }

    fn truth(&self, index: usize) -> Option<Pose> {
        self.frames.get(index)?.truth
    }
}
