//! Cameras and what a session says of its sensor.

use crate::field::{At, FieldError, Wire};
use crate::geometry::finite;
use crate::v1;
use coma_frame::DepthNoise;
use coma_geometry::{Distortion, Intrinsics, Pose};

impl Wire for Intrinsics {
    type Message = v1::Intrinsics;

    fn to_wire(&self) -> v1::Intrinsics {
        let Intrinsics { width, height, fx, fy, cx, cy } = *self;
        v1::Intrinsics { width, height, fx, fy, cx, cy }
    }

    fn from_wire(m: v1::Intrinsics, at: &At<'_>) -> Result<Self, FieldError> {
        let v1::Intrinsics { width, height, fx, fy, cx, cy } = m;
        Intrinsics { width, height, fx, fy, cx, cy }
            .validated()
            .map_err(|e| at.field(e.field).refuse(format!("{} is out of range: {}", e.value, e.needed)))
    }
}

impl Wire for Distortion {
    type Message = v1::Distortion;

    fn to_wire(&self) -> v1::Distortion {
        let Distortion { k1, k2, p1, p2, k3 } = *self;
        v1::Distortion { k1, k2, p1, p2, k3 }
    }

    fn from_wire(m: v1::Distortion, at: &At<'_>) -> Result<Self, FieldError> {
        for (name, value) in [("k1", m.k1), ("k2", m.k2), ("p1", m.p1), ("p2", m.p2), ("k3", m.k3)] {
            if !(value.abs() <= 100.0) {
                return Err(at.field(name).refuse(format!("{value} is not within -100 and 100")));
            }
        }
        Ok(Distortion { k1: m.k1, k2: m.k2, p1: m.p1, p2: m.p2, k3: m.k3 })
    }
}

impl Wire for DepthNoise {
    type Message = v1::DepthNoise;

    fn to_wire(&self) -> v1::DepthNoise {
        v1::DepthNoise { base_m: self.base_m.into(), quadratic_per_m: self.quadratic_per_m.into() }
    }

    fn from_wire(m: v1::DepthNoise, at: &At<'_>) -> Result<Self, FieldError> {
        if !(m.base_m >= 1e-6 && m.base_m <= 1.0) {
            return Err(at.field("base_m").refuse(format!("{} is not within 1e-6 and 1 m", m.base_m)));
        }
        if !(m.quadratic_per_m >= 0.0 && m.quadratic_per_m <= 1.0) {
            let message = format!("{} is not within 0 and 1 per metre", m.quadratic_per_m);
            return Err(at.field("quadratic_per_m").refuse(message));
        }
        Ok(DepthNoise { base_m: m.base_m as f32, quadratic_per_m: m.quadratic_per_m as f32 })
    }
}

/// What a session states once about its sensor, checked.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibration {
    /// Which camera of the session; one today.
    pub camera_id: u32,
    /// The colour camera.
    pub color: Intrinsics,
    /// The depth camera; `None` if depth is registered to colour and shares its camera.
    pub depth: Option<Intrinsics>,
    /// The colour lens.
    pub color_distortion: Distortion,
    /// The depth lens.
    pub depth_distortion: Distortion,
    /// Identity where the message names none.
    pub color_from_depth: Pose,
    /// Raw depth units in one metre.
    pub depth_units_per_metre: f64,
    /// How wrong the depth is.
    pub depth_noise: DepthNoise,
    /// Nearer depth is no measurement; 0 = no bound.
    pub depth_min_m: f64,
    /// Farther depth is no measurement; `None` = no bound.
    pub depth_max_m: Option<f64>,
    /// Identity where the message names none.
    pub body_from_camera: Pose,
    /// From the first row to the last, seconds.
    pub rolling_shutter_s: f64,
}

impl Calibration {
    /// The camera of raw depth images.
    pub fn depth_camera(&self) -> &Intrinsics {
        self.depth.as_ref().unwrap_or(&self.color)
    }

    /// An ideal camera whose depth is registered to colour.
    pub fn registered(color: Intrinsics, depth_units_per_metre: f64) -> Self {
        Calibration {
            camera_id: 0,
            color,
            depth: None,
            color_distortion: Distortion::default(),
            depth_distortion: Distortion::default(),
            color_from_depth: Pose::identity(),
            depth_units_per_metre,
            depth_noise: DepthNoise::default(),
            depth_min_m: 0.0,
            depth_max_m: None,
            body_from_camera: Pose::identity(),
            rolling_shutter_s: 0.0,
        }
    }
}

impl Wire for Calibration {
    type Message = v1::Calibration;

    fn to_wire(&self) -> v1::Calibration {
        let unless_identity = |pose: &Pose| (*pose != Pose::identity()).then(|| pose.to_wire());
        let unless_ideal = |lens: &Distortion| (!lens.is_none()).then(|| lens.to_wire());
        v1::Calibration {
            camera_id: self.camera_id,
            color: Some(self.color.to_wire()),
            depth: self.depth.as_ref().map(Wire::to_wire),
            color_distortion: unless_ideal(&self.color_distortion),
            depth_distortion: unless_ideal(&self.depth_distortion),
            color_from_depth: unless_identity(&self.color_from_depth),
            depth_units_per_metre: self.depth_units_per_metre,
            depth_noise: Some(self.depth_noise.to_wire()),
            depth_min_m: self.depth_min_m,
            depth_max_m: self.depth_max_m.unwrap_or(0.0),
            body_from_camera: unless_identity(&self.body_from_camera),
            rolling_shutter_s: self.rolling_shutter_s,
        }
    }

    fn from_wire(m: v1::Calibration, at: &At<'_>) -> Result<Self, FieldError> {
        let color: Intrinsics = at.field("color").required(m.color)?;
        let depth: Option<Intrinsics> = at.field("depth").optional(m.depth)?;
        let color_from_depth: Option<Pose> = at.field("color_from_depth").optional(m.color_from_depth)?;
        let depth_distortion: Option<Distortion> =
            at.field("depth_distortion").optional(m.depth_distortion)?;
        if depth.is_none() && (color_from_depth.is_some() || depth_distortion.is_some()) {
            return Err(at.field("depth").refuse(
                "is missing, but color_from_depth or depth_distortion says that depth has its own camera",
            ));
        }
        let units = m.depth_units_per_metre;
        if !(1.0..=1e6).contains(&units) {
            return Err(at.field("depth_units_per_metre").refuse(format!("{units} is not within 1 and 1e6")));
        }
        let min = finite(m.depth_min_m, &at.field("depth_min_m"))?;
        let max = finite(m.depth_max_m, &at.field("depth_max_m"))?;
        if min < 0.0 {
            return Err(at.field("depth_min_m").refuse(format!("{min} is negative")));
        }
        if max != 0.0 && !(max > min) {
            let message = format!("{max} is not over depth_min_m = {min}; 0 sets no bound");
            return Err(at.field("depth_max_m").refuse(message));
        }
        if !(m.rolling_shutter_s >= 0.0 && m.rolling_shutter_s <= 1.0) {
            let message = format!("{} is not within 0 and 1 s", m.rolling_shutter_s);
            return Err(at.field("rolling_shutter_s").refuse(message));
        }
        if m.camera_id != 0 {
            let message = format!("{} is unknown: a session has one camera, 0", m.camera_id);
            return Err(at.field("camera_id").refuse(message));
        }
        Ok(Calibration {
            camera_id: m.camera_id,
            color,
            depth,
            color_distortion: at.field("color_distortion").optional(m.color_distortion)?.unwrap_or_default(),
            depth_distortion: depth_distortion.unwrap_or_default(),
            color_from_depth: color_from_depth.unwrap_or_else(Pose::identity),
            depth_units_per_metre: units,
            depth_noise: at.field("depth_noise").optional(m.depth_noise)?.unwrap_or_default(),
            depth_min_m: min,
            depth_max_m: (max != 0.0).then_some(max),
            body_from_camera: at
                .field("body_from_camera")
                .optional(m.body_from_camera)?
                .unwrap_or_else(Pose::identity),
            rolling_shutter_s: m.rolling_shutter_s,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Intrinsics =
        Intrinsics { width: 640, height: 480, fx: 525.0, fy: 525.0, cx: 319.5, cy: 239.5 };

    #[test]
    fn a_calibration_survives_the_wire() {
        let mut calibration = Calibration::registered(CAMERA, 5000.0);
        let read = Calibration::from_wire(calibration.to_wire(), &At::ROOT).unwrap();
        assert_eq!(read, calibration);
        calibration.depth = Some(CAMERA);
        calibration.color_from_depth = Pose::translation(0.02, 0.0, 0.0);
        calibration.depth_distortion.k1 = -0.1;
        calibration.depth_max_m = Some(8.0);
        assert_eq!(Calibration::from_wire(calibration.to_wire(), &At::ROOT).unwrap(), calibration);
    }

    #[test]
    fn a_wrong_calibration_is_refused_by_field() {
        let good = Calibration::registered(CAMERA, 1000.0).to_wire();
        let at = At::Root("calibration");
        let refused = |m| Calibration::from_wire(m, &at).unwrap_err().field;
        let with_fx = |fx| Some(v1::Intrinsics { fx, ..CAMERA.to_wire() });
        assert_eq!(refused(v1::Calibration { color: with_fx(f64::NAN), ..good }), "calibration.color.fx");
        assert_eq!(refused(v1::Calibration { depth: with_fx(0.0), ..good }), "calibration.depth.fx");
        assert_eq!(refused(v1::Calibration { color: None, ..good }), "calibration.color");
        assert_eq!(
            refused(v1::Calibration { depth_units_per_metre: 0.0, ..good }),
            "calibration.depth_units_per_metre"
        );
        assert_eq!(refused(v1::Calibration { depth_max_m: -1.0, ..good }), "calibration.depth_max_m");
        assert_eq!(refused(v1::Calibration { camera_id: 7, ..good }), "calibration.camera_id");
        let lens = v1::Distortion { k2: f64::INFINITY, ..Default::default() };
        assert_eq!(
            refused(v1::Calibration { color_distortion: Some(lens), ..good }),
            "calibration.color_distortion.k2"
        );
        let shift = Some(Pose::translation(0.1, 0.0, 0.0).to_wire());
        assert_eq!(refused(v1::Calibration { color_from_depth: shift, ..good }), "calibration.depth");
    }
}
