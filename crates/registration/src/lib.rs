//! Rigid registration of two RGB-D views that share part of a scene, from no initial guess.
//!
//! The steps, one file each, in order:
//!
//! 1. [`view`]: what one side knows (depth, intensity, camera), reduced to a working size.
//! 2. [`cloud`]: point clouds at several voxel sizes, with normals and intensity gradients.
//! 3. [`fpfh`]: Fast Point Feature Histograms (Rusu, Blodow, Beetz 2009).
//! 4. [`matching`]: mutual nearest neighbours among the features.
//! 5. [`consensus`]: RANSAC over matches that keep distances and angles, several hypotheses.
//! 6. [`icp`]: multi-scale coloured ICP (Park, Zhou, Koltun 2017), both directions in one system; or [`gicp`],
//!    generalised ICP (Segal, Haehnel, Thrun 2009), where brightness says nothing. Its last scale are the [`pixels`].
//! 7. [`information`]: an information matrix that can be believed, and whether the scene pins all six degrees of freedom,
//!    and pins them though the focal lengths are a little wrong.
//! 8. [`verify`]: overlap, free-space conflicts and photometric agreement, broad and in [`detail`], at the found pose.
//!
//! [`align`] runs them all and ends as [`Outcome::Accepted`] or [`Outcome::Rejected`] with its reason.
//! [`coarse`], [`decide`], [`refine`] and [`verify::verify`] are the parts.
//!
//! Poses are `target_from_source`. Tangents and information matrices are in the order of
//! `coma_geometry` (translation, rotation), perturbed on the right: `target_from_source * exp(xi)`.
//! The same views, settings and seed give the same bits, whatever the number of threads.

pub mod align;
pub mod cloud;
pub mod consensus;
pub mod detail;
pub mod fpfh;
pub mod gicp;
pub mod icp;
pub mod information;
pub mod matching;
pub mod neighbours;
pub mod outcome;
pub mod pixels;
pub mod settings;
pub mod verify;
pub mod view;

pub use align::{Hypothesis, align, align_prepared, coarse, decide, refine};
pub use cloud::PointCloud;
pub use outcome::{Alignment, Outcome, Reason, Side};
pub use settings::{Refiner, Settings};
pub use verify::{Evidence, verify};
pub use view::{Prepared, View};
