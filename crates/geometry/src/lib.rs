//! The words everything else is said in: rigid motions, cameras, identifiers, time.
//!
//! * Frames of reference: `camera` (x right, y down, z forward), `submap` (its first keyframe's
//!   camera), `agent` (where that agent began), `map` (shared by one connected component).
//! * A transform names both ends, and the names touch: `map_from_submap * submap_from_camera`.
//! * Metres, radians, seconds. `f64` for poses; images and surfels are `f32`.
//! * The tangent of SE(3) is `(translation, rotation)`, perturbed on the right:
//!   `pose ⊞ ξ = pose * exp(ξ)`. See [`se3`].
//!
//! `docs/conventions.md` in the repository lists every convention with the test that holds it.

pub mod alignment;
pub mod camera;
pub mod id;
pub mod se3;
pub mod time;
pub mod tum;

pub use camera::{Distortion, Intrinsics, IntrinsicsError};
pub use id::{AgentId, Epoch, InvalidAgentId, InvalidMapId, KeyframeId, MapId, SubmapId};
pub use nalgebra;
pub use time::StampNs;

/// A rigid motion. Name it by its ends: `map_from_camera`.
pub type Pose = nalgebra::Isometry3<f64>;
/// A tangent vector of SE(3): `(tx, ty, tz, rx, ry, rz)`, metres and radians.
pub type Tangent = nalgebra::Vector6<f64>;
/// A 6x6 information or covariance matrix in the order of [`Tangent`].
pub type Matrix6 = nalgebra::Matrix6<f64>;
