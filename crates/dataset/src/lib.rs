//! RGB-D sequences with calibration and ground truth: recorded data sets, and a built-in world.
//!
//! [`open`] reads what a [`Spec`] names and gives a [`Sequence`]; [`open_all`] gives every agent of a
//! multi-agent folder. Frames keep the bytes that lie on disk, so that a client streams those;
//! [`RawFrame::decode`] makes them into the frame that an estimator sees. Only programs and tests may use this crate:
//! ground truth must not reach an estimator.

pub mod error;
mod files;
mod multi_agent;
mod replica;
pub mod sequence;
mod seven_scenes;
pub mod spec;
pub mod synth;
mod tum;
pub mod world;

pub use error::DatasetError;
pub use sequence::{Calibration, ColorBytes, DepthBytes, RawFrame, Sequence};
pub use spec::{Format, NamedSequence, Spec, SpecError, open, open_all};
pub use synth::write_tum;
