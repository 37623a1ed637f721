//! What can be wrong with settings or with bytes from outside.

/// Why depth could not be encoded or decoded.
#[derive(Debug, thiserror::Error)]
pub enum DepthCodecError {
    /// A setting, or a parameter in the header, out of its range.
    #[error("{name} is {value}, expected {expected}")]
    Setting {
        /// Its name.
        name: &'static str,
        /// Its value.
        value: f64,
        /// What would be right.
        expected: &'static str,
    },
    /// The noise-proportional steps need more codes than 16 bits hold.
    #[error("steps of {step_m} m at {near_m} m need more than 65535 levels to reach {far_m} m")]
    TooManyLevels {
        /// The first step, metres.
        step_m: f64,
        /// Nearest depth, metres.
        near_m: f64,
        /// Farthest depth, metres.
        far_m: f64,
    },
    /// An image without pixels, or with a side over 32 bits.
    #[error("an image of {width}x{height} pixels cannot be encoded")]
    Size {
        /// Width in pixels.
        width: usize,
        /// Height in pixels.
        height: usize,
    },
    /// An image over the decoder's limit.
    #[error("an image of {width}x{height} pixels is over the limit of {max_pixels} pixels")]
    TooLarge {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// The limit.
        max_pixels: usize,
    },
    /// The first bytes are not those of this codec.
    #[error("not a depth image of this codec: it does not begin with CDPT")]
    NotThisCodec,
    /// Written by a later version.
    #[error("version {found} of the depth codec is not known, 1 is")]
    Version {
        /// The version found.
        found: u8,
    },
    /// The bytes end too early.
    #[error("truncated: {what} needs {needed} bytes, {left} are left")]
    Truncated {
        /// What was being read.
        what: &'static str,
        /// Bytes it takes.
        needed: usize,
        /// Bytes there are.
        left: usize,
    },
    /// The checksum at the end does not fit.
    #[error("damaged: the checksum is {found:08x}, the bytes give {computed:08x}")]
    Checksum {
        /// As stored.
        found: u32,
        /// As computed.
        computed: u32,
    },
    /// Well-formed bytes that contradict one another.
    #[error("malformed {what}: {found}, expected {expected}")]
    Malformed {
        /// The part of the image.
        what: &'static str,
        /// The number found.
        found: usize,
        /// The number that would be right, or the largest one.
        expected: usize,
    },
    /// Zstd could not pack or unpack a section.
    #[error("zstd on {what}: {source}")]
    Zstd {
        /// The section.
        what: &'static str,
        /// Zstd's own words.
        source: std::io::Error,
    },
    /// [`decode_u16`](crate::decode_u16) of an image that was quantised.
    #[error("the image was quantised: it has no lossless 16-bit form")]
    NotLossless,
}
