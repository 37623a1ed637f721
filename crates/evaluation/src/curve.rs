//! A track frame by frame, for plots and for whoever looks for the frame at which it went wrong.

use coma_geometry::{AgentId, StampNs};
use serde::{Deserialize, Serialize};

/// One track's frames.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Curve {
    /// Whose.
    pub agent: AgentId,
    /// In which component.
    pub component: String,
    /// True if positions are in the frame of the truth (by the component's alignment); they stay in the map's
    /// where the component could not be aligned.
    pub aligned: bool,
    /// In the order of time.
    pub points: Vec<CurvePoint>,
}

/// One frame of a track.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CurvePoint {
    /// Of the estimate.
    pub stamp: StampNs,
    /// Where the camera was thought to be, metres.
    pub estimate_m: [f64; 3],
    /// Where it was, where that is known, metres.
    pub truth_m: Option<[f64; 3]>,
    /// Distance of the two under protocol H (the component's alignment), metres.
    pub error_h_m: Option<f64>,
    /// Distance of the two under protocol P (the track's own alignment), metres.
    pub error_p_m: Option<f64>,
}

impl Curve {
    /// The point of a stamp.
    pub fn at(&self, stamp: StampNs) -> Option<&CurvePoint> {
        let index = self.points.binary_search_by_key(&stamp, |point| point.stamp).ok()?;
        self.points.get(index)
    }
}
