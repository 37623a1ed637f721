//! Faults on purpose: a covered lens, a depth sensor that sees nothing.

use anyhow::{Context, bail};
use coma_dataset::{Calibration, ColorBytes, DatasetError, DepthBytes, RawFrame, Sequence};
use coma_frame::Image;
use coma_geometry::{Pose, StampNs};
use std::str::FromStr;

/// What goes wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    /// Black pictures without depth.
    Blackout,
    /// No pixel has depth.
    NoDepth,
}

/// A fault and its frames: `blackout:100-129` or `nodepth:100-129`, both ends included.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fault {
    kind: Kind,
    first: usize,
    last: usize,
}

impl FromStr for Fault {
    type Err = anyhow::Error;

    fn from_str(text: &str) -> anyhow::Result<Self> {
        let needed =
            "a fault is blackout:FIRST-LAST or nodepth:FIRST-LAST, frames counted from 0, both ends included";
        let (kind, range) = text.split_once(':').context(needed)?;
        let kind = match kind {
            "blackout" => Kind::Blackout,
            "nodepth" => Kind::NoDepth,
            _ => bail!("{kind:?} is no fault: {needed}"),
        };
        let (first, last) = range.split_once('-').context(needed)?;
        let number = |s: &str| s.parse::<usize>().with_context(|| format!("{s:?} is no frame: {needed}"));
        let fault = Fault { kind, first: number(first)?, last: number(last)? };
        if fault.first > fault.last {
            bail!("{range:?} runs backwards: {needed}");
        }
        Ok(fault)
    }
}

/// A sequence with faults.
struct Faulty {
    inner: Box<dyn Sequence>,
    faults: Vec<Fault>,
}

/// The sequence, with some of its frames spoilt.
pub fn spoil(inner: Box<dyn Sequence>, faults: &[Fault]) -> Box<dyn Sequence> {
    if faults.is_empty() { inner } else { Box::new(Faulty { inner, faults: faults.to_vec() }) }
}

/// Whether a camera with these faults sees nothing useful in a frame.
pub fn blinds(faults: &[Fault], index: usize) -> bool {
    faults.iter().any(|f| (f.first..=f.last).contains(&index))
}

impl Sequence for Faulty {
    fn calibration(&self) -> &Calibration {
        self.inner.calibration()
    }

    fn len(&self) -> usize {
        self.inner.len()
    }

    fn stamp_text(&self, index: usize) -> &str {
        self.inner.stamp_text(index)
    }

    fn stamp(&self, index: usize) -> StampNs {
        self.inner.stamp(index)
    }

    fn frame(&self, index: usize) -> Result<RawFrame, DatasetError> {
        let mut frame = self.inner.frame(index)?;
        let calibration = self.inner.calibration();
        for fault in self.faults.iter().filter(|f| (f.first..=f.last).contains(&index)) {
            let (color, depth) = (&calibration.color, &calibration.depth);
            frame.depth = DepthBytes::Raw16(Image::filled(depth.width as usize, depth.height as usize, 0));
            if fault.kind == Kind::Blackout {
                frame.color =
                    ColorBytes::Rgb8(Image::filled(color.width as usize, color.height as usize, [0; 3]));
            }
        }
        Ok(frame)
    }

    fn truth(&self, index: usize) -> Option<Pose> {
        self.inner.truth(index)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fault_names_its_kind_and_both_ends() {
        let fault: Fault = "blackout:100-129".parse().unwrap();
        assert_eq!(fault, Fault { kind: Kind::Blackout, first: 100, last: 129 });
        assert!(blinds(&[fault], 129) && !blinds(&[fault], 130));
        for bad in ["blackout", "fog:1-2", "nodepth:5-4", "nodepth:x-4", "nodepth:7"] {
            let error = bad.parse::<Fault>().unwrap_err().to_string();
            assert!(error.contains("a fault is"), "{bad}: {error}");
        }
    }
}
