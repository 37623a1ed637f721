//! Compressed depth images.
//!
//! Depth is turned into whole codes (0 = no measurement), predicted from its neighbours with the predictor that
//! fits best in each 8x8 block, and what is left is folded to unsigned (zigzag), run-length coded and packed with
//! Zstd: the depth codec of CoMA-SLAM (AAAI 2026). Three ways of turning metres into codes are offered
//! ([`Quantisation`]); the decoder returns, with the depth, how far it can be from the original
//! ([`ErrorBound`]). Bytes from anywhere can be handed to [`decode`]: it returns an error rather than panic, and
//! allocates in proportion to [`Limits::max_pixels`] only.
//!
//! ```
//! use coma_depth_codec::{Limits, Quantisation, Settings, decode, encode};
//! use coma_frame::Image;
//! let depth_m = Image::from_fn(64, 48, |x, y| 1.0 + 0.01 * (x + y) as f32);
//! let settings = Settings { quantisation: Quantisation::Linear12 { near_m: 0.0, far_m: 10.0 }, ..Settings::default() };
//! let bytes = encode(&depth_m, &settings)?;
//! let decoded = decode(&bytes, Limits::default())?;
//! assert!((decoded.depth_m[(5, 5)] - 1.1).abs() <= decoded.max_error.at_m(1.1));
//! # Ok::<(), coma_depth_codec::DepthCodecError>(())
//! ```
//!
//! # Layout
//! All numbers are little-endian.
//!
//! | bytes | meaning |
//! |---|---|
//! | 4 | `CDPT` |
//! | 1 | version, 1 |
//! | 1 | quantisation: 0 lossless 16 bit, 1 linear 12 bit, 2 in proportion to noise |
//! | 4 + 4 | width, height in pixels |
//! | 4, 8 or 20 | its parameters as f32: `units_per_metre`; `near_m, far_m`; `base_m, quadratic_per_m, fraction, near_m, far_m` |
//! | | section *mask*: one bit per pixel, row by row, lowest bit first, 1 = measured |
//! | | section *predictors*: one byte per 8x8 block, row by row |
//! | | section *escapes*: residuals of 254 and above, 3 bytes each |
//! | | sections *residuals 0..7*, one per context |
//! | 4 | FNV-1a of all bytes before |
//!
//! A section is `raw length: u32, packed length: u32`, and one Zstd frame; an empty section has no frame. Pixels
//! are visited row by row. A pixel without measurement takes the value of its left (in the first column: upper)
//! neighbour for the prediction of others. The context of a measured pixel is the sum of its neighbours' absolute
//! differences `|left - upleft| + |up - upleft| + |upright - up|`, in eight classes: a flat wall and an edge do not
//! share one statistic. Residuals of a context are bytes: 0 and 1 are digits of a run of zeros (bijective base 2,
//! lowest first), 2 to 254 a zigzag residual plus one, 255 an escape.
mod container;
mod error;
mod predict;
mod quantise;
mod runs;

pub use error::DepthCodecError;
pub use quantise::{ErrorBound, Quantisation};

use coma_frame::Image;
use container::{Header, Reader};
use predict::Planes;
use quantise::Codes;

/// How depth is encoded.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// How metres become whole codes.
    pub quantisation: Quantisation,
    /// Zstd's level, 1 to 19: more is slightly smaller and much slower. Origin: Zstd's own default, 3.
    pub zstd_level: i32,
}

impl Default for Settings {
    /// Lossless for depth in millimetres.
    fn default() -> Self {
        Settings { quantisation: Quantisation::Lossless16 { units_per_metre: 1000.0 }, zstd_level: 3 }
    }
}

/// What a decoder may be made to allocate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// The largest width times height accepted. Decoding takes at most about 16 bytes a pixel.
    pub max_pixels: usize,
}

impl Default for Limits {
    /// 4096 x 4096 pixels: beyond the depth cameras of today.
    fn default() -> Self {
        Limits { max_pixels: 1 << 24 }
    }
}

/// A decoded depth image.
#[derive(Clone, Debug, PartialEq)]
pub struct Decoded {
    /// Depth in metres, 0 = no measurement; `[height, width]`.
    pub depth_m: Image<f32>,
    /// How far a measured pixel can be from the encoded one.
    pub max_error: ErrorBound,
}

/// Encodes depth in metres. Zero, negative and not finite values are "no measurement"; so are values which the
/// quantisation cannot hold (see [`Quantisation`]).
///
/// # Errors
/// Settings out of range, an empty image or one whose sides exceed 32 bits.
pub fn encode(depth_m: &Image<f32>, settings: &Settings) -> Result<Vec<u8>, DepthCodecError> {
    let (codes, stored) = Codes::of(depth_m, &settings.quantisation)?;
    encode_codes(&codes, stored, settings.zstd_level)
}

/// Encodes a sensor's own 16-bit depth, without loss; 0 = no measurement.
///
/// # Errors
/// `units_per_metre` not positive and finite, an empty image or one whose sides exceed 32 bits.
pub fn encode_u16(
    depth: &Image<u16>,
    units_per_metre: f32,
    zstd_level: i32,
) -> Result<Vec<u8>, DepthCodecError> {
    let stored = quantise::Stored::lossless(units_per_metre)?;
    encode_codes(depth, stored, zstd_level)
}

fn encode_codes(
    codes: &Image<u16>,
    stored: quantise::Stored,
    zstd_level: i32,
) -> Result<Vec<u8>, DepthCodecError> {
    if !(1..=19).contains(&zstd_level) {
        return Err(DepthCodecError::Setting {
            name: "zstd_level",
            value: zstd_level as f64,
            expected: "1 to 19",
        });
    }
    let header = Header::new(codes.width(), codes.height(), stored)?;
    container::write(&header, &Planes::of(codes), zstd_level)
}

/// Decodes what [`encode`] or [`encode_u16`] made.
///
/// # Errors
/// Bytes that are no such image, damaged ones, and images over `limits`.
pub fn decode(bytes: &[u8], limits: Limits) -> Result<Decoded, DepthCodecError> {
    let (header, codes) = decode_codes(bytes, limits)?;
    let depth_of_code = header.stored.depth_of_code()?;
    let mut pixels = Vec::with_capacity(codes.pixels().len());
    for code in codes.pixels() {
        pixels.push(depth_of_code.get(*code)?);
    }
    let depth_m = Image::from_pixels(codes.width(), codes.height(), pixels).expect("one depth per code");
    Ok(Decoded { depth_m, max_error: header.stored.error_bound() })
}

/// Decodes a lossless image to the sensor's own units: the image, and units per metre.
///
/// # Errors
/// As [`decode`]; and [`DepthCodecError::NotLossless`] for an image that was quantised.
pub fn decode_u16(bytes: &[u8], limits: Limits) -> Result<(Image<u16>, f32), DepthCodecError> {
    let (header, codes) = decode_codes(bytes, limits)?;
    match header.stored {
        quantise::Stored::Lossless16 { units_per_metre } => Ok((codes, units_per_metre)),
        _ => Err(DepthCodecError::NotLossless),
    }
}

fn decode_codes(bytes: &[u8], limits: Limits) -> Result<(Header, Image<u16>), DepthCodecError> {
    let mut reader = Reader::checked(bytes)?;
    let header = Header::read(&mut reader, limits)?;
    let planes = container::read_planes(&mut reader, &header)?;
    let codes = planes.into_codes(header.width, header.height)?;
    Ok((header, codes))
}
