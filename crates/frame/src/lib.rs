//! RGB-D frames: images, depth noise, pyramids, normals, and registering depth to colour.

pub mod image;
pub mod ingest;
pub mod noise;
pub mod normals;
pub mod pyramid;
pub mod rgbd;

pub use image::{Image, luminance};
pub use noise::DepthNoise;
pub use rgbd::{FrameError, RgbdFrame};
