//! The bytes around the planes: header, Zstd sections, checksum.

use crate::predict::{CONTEXTS, Planes, block_count};
use crate::quantise::Stored;
use crate::{DepthCodecError, Limits, runs};
use coma_frame::DepthNoise;
use zstd::zstd_safe::{CParameter, Strategy};

const MAGIC: &[u8; 4] = b"CDPT";
const VERSION: u8 = 1;

/// What the first bytes say.
pub(crate) struct Header {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) stored: Stored,
}

impl Header {
    pub(crate) fn new(width: usize, height: usize, stored: Stored) -> Result<Header, DepthCodecError> {
        let fits = |side: usize| side > 0 && u32::try_from(side).is_ok();
        if !(fits(width) && fits(height) && width.checked_mul(height).is_some()) {
            return Err(DepthCodecError::Size { width, height });
        }
        Ok(Header { width, height, stored })
    }

    fn write(&self, out: &mut Vec<u8>) {
        out.extend_from_slice(MAGIC);
        out.push(VERSION);
        let (kind, parameters): (u8, &[f32]) = match self.stored {
            Stored::Lossless16 { units_per_metre } => (0, &[units_per_metre]),
            Stored::Linear12 { near_m, far_m } => (1, &[near_m, far_m]),
            Stored::Noise { noise, fraction, near_m, far_m } => {
                (2, &[noise.base_m, noise.quadratic_per_m, fraction, near_m, far_m])
            }
        };
        out.push(kind);
        out.extend_from_slice(&(self.width as u32).to_le_bytes());
        out.extend_from_slice(&(self.height as u32).to_le_bytes());
        parameters.iter().for_each(|p| out.extend_from_slice(&p.to_le_bytes()));
    }

    pub(crate) fn read(reader: &mut Reader, limits: Limits) -> Result<Header, DepthCodecError> {
        let kind = reader.take("quantisation", 1)?[0];
        let (width, height) = (reader.u32("width")?, reader.u32("height")?);
        let pixels = width as u64 * height as u64;
        if pixels > limits.max_pixels as u64 {
            return Err(DepthCodecError::TooLarge { width, height, max_pixels: limits.max_pixels });
        }
        let mut f32 = |what| reader.u32(what).map(f32::from_bits);
        let stored = match kind {
            0 => Stored::Lossless16 { units_per_metre: f32("units_per_metre")? },
            1 => Stored::Linear12 { near_m: f32("near_m")?, far_m: f32("far_m")? },
            2 => Stored::Noise {
                noise: DepthNoise { base_m: f32("base_m")?, quadratic_per_m: f32("quadratic_per_m")? },
                fraction: f32("fraction")?,
                near_m: f32("near_m")?,
                far_m: f32("far_m")?,
            },
            _ => {
                return Err(DepthCodecError::Malformed {
                    what: "quantisation",
                    found: kind as usize,
                    expected: 2,
                });
            }
        };
        stored.check()?;
        Header::new(width as usize, height as usize, stored)
    }
}

/// Writes a whole image.
pub(crate) fn write(header: &Header, planes: &Planes, level: i32) -> Result<Vec<u8>, DepthCodecError> {
    let mut packer = Packer::new(level)?;
    let mut out = Vec::with_capacity(header.width * header.height / 2 + 64);
    header.write(&mut out);
    packer.section("mask", &planes.mask, &mut out)?;
    packer.section("predictors", &planes.predictors, &mut out)?;
    packer.section("escapes", &planes.escapes, &mut out)?;
    for symbols in &planes.symbols {
        packer.section("residuals", &runs::pack(symbols), &mut out)?;
    }
    let checksum = fnv1a(&out);
    out.extend_from_slice(&checksum.to_le_bytes());
    Ok(out)
}

/// Reads the sections of an image whose header was read.
pub(crate) fn read_planes(reader: &mut Reader, header: &Header) -> Result<Planes, DepthCodecError> {
    let pixels = header.width * header.height;
    let mask = reader.section("mask", pixels.div_ceil(8))?;
    let predictors = reader.section("predictors", block_count(header.width, header.height))?;
    for (what, found, expected) in [
        ("length of the mask", mask.len(), pixels.div_ceil(8)),
        ("number of predictors", predictors.len(), block_count(header.width, header.height)),
    ] {
        if found != expected {
            return Err(DepthCodecError::Malformed { what, found, expected });
        }
    }
    // Every measured pixel is one symbol of one context, and escapes are at most one each.
    let mut left = mask.iter().map(|byte| byte.count_ones() as usize).sum::<usize>();
    let escapes = reader.section("escapes", 3 * left)?;
    let mut symbols: [Vec<u8>; CONTEXTS] = Default::default();
    for stream in &mut symbols {
        let packed = reader.section("residuals", left)?;
        *stream = runs::unpack(&packed, left)?;
        left -= stream.len();
    }
    if !reader.bytes.is_empty() {
        return Err(DepthCodecError::Malformed {
            what: "number of bytes left over",
            found: reader.bytes.len(),
            expected: 0,
        });
    }
    Ok(Planes { mask, predictors, symbols, escapes })
}

struct Packer(zstd::bulk::Compressor<'static>);

impl Packer {
    fn new(level: i32) -> Result<Packer, DepthCodecError> {
        let failed = |source| DepthCodecError::Zstd { what: "its settings", source };
        let mut compressor = zstd::bulk::Compressor::new(level).map_err(failed)?;
        // Residuals hardly repeat: short matches only disturb the entropy coder, which does the work here.
        if level <= 5 {
            compressor.set_parameter(CParameter::Strategy(Strategy::ZSTD_greedy)).map_err(failed)?;
        }
        compressor.set_parameter(CParameter::MinMatch(7)).map_err(failed)?;
        Ok(Packer(compressor))
    }

    fn section(&mut self, what: &'static str, raw: &[u8], out: &mut Vec<u8>) -> Result<(), DepthCodecError> {
        let packed = if raw.is_empty() {
            Vec::new()
        } else {
            self.0.compress(raw).map_err(|source| DepthCodecError::Zstd { what, source })?
        };
        for length in [raw.len(), packed.len()] {
            let length = u32::try_from(length).map_err(|_| DepthCodecError::Malformed {
                what,
                found: length,
                expected: u32::MAX as usize,
            })?;
            out.extend_from_slice(&length.to_le_bytes());
        }
        out.extend_from_slice(&packed);
        Ok(())
    }
}

/// Reads bytes from outside.
pub(crate) struct Reader<'a> {
    bytes: &'a [u8],
}

impl<'a> Reader<'a> {
    /// After magic, version and checksum were found right; the checksum is cut off.
    pub(crate) fn checked(bytes: &'a [u8]) -> Result<Reader<'a>, DepthCodecError> {
        let mut reader = Reader { bytes };
        if reader.take("the first bytes", 4)? != MAGIC {
            return Err(DepthCodecError::NotThisCodec);
        }
        let version = reader.take("version", 1)?[0];
        if version != VERSION {
            return Err(DepthCodecError::Version { found: version });
        }
        let left = reader.bytes.len();
        let Some((body, stored)) = reader.bytes.split_last_chunk::<4>() else {
            return Err(DepthCodecError::Truncated { what: "checksum", needed: 4, left });
        };
        let (found, computed) = (u32::from_le_bytes(*stored), fnv1a(&bytes[..bytes.len() - 4]));
        if found != computed {
            return Err(DepthCodecError::Checksum { found, computed });
        }
        Ok(Reader { bytes: body })
    }

    fn take(&mut self, what: &'static str, count: usize) -> Result<&'a [u8], DepthCodecError> {
        let left = self.bytes.len();
        let (head, tail) = self.bytes.split_at_checked(count).ok_or(DepthCodecError::Truncated {
            what,
            needed: count,
            left,
        })?;
        self.bytes = tail;
        Ok(head)
    }

    fn u32(&mut self, what: &'static str) -> Result<u32, DepthCodecError> {
        Ok(u32::from_le_bytes(self.take(what, 4)?.try_into().expect("four bytes were taken")))
    }

    /// One section of at most `max_raw` bytes.
    fn section(&mut self, what: &'static str, max_raw: usize) -> Result<Vec<u8>, DepthCodecError> {
        let (raw, packed) = (self.u32(what)? as usize, self.u32(what)? as usize);
        if raw > max_raw {
            return Err(DepthCodecError::Malformed { what, found: raw, expected: max_raw });
        }
        let packed = self.take(what, packed)?;
        if raw == 0 {
            return match packed.len() {
                0 => Ok(Vec::new()),
                found => Err(DepthCodecError::Malformed { what, found, expected: 0 }),
            };
        }
        let unpacked =
            zstd::bulk::decompress(packed, raw).map_err(|source| DepthCodecError::Zstd { what, source })?;
        if unpacked.len() != raw {
            return Err(DepthCodecError::Malformed { what, found: unpacked.len(), expected: raw });
        }
        Ok(unpacked)
    }
}

/// The 32-bit FNV-1a hash: a guard against damage, not against malice (evidence is named by its own hash).
fn fnv1a(bytes: &[u8]) -> u32 {
    bytes.iter().fold(0x811c_9dc5, |hash, byte| (hash ^ *byte as u32).wrapping_mul(0x0100_0193))
}
