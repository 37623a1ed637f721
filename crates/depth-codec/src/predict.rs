//! Prediction of depth codes from their neighbours, the best predictor per 8x8 block.

use crate::DepthCodecError;
use crate::runs::MAX_SYMBOL;
use coma_frame::Image;

/// Side of a block, pixels.
const BLOCK: usize = 8;
/// Number of predictors.
const PREDICTORS: usize = 7;
/// Number of contexts.
pub(crate) const CONTEXTS: usize = 8;
/// What a block must gain, in sixteenths of a bit, before it leaves the usual predictor: its neighbours' choice
/// costs less to write than its own.
const SWITCH_COST: u32 = 48;
/// The median edge detector of JPEG-LS.
const USUAL: u8 = 4;

/// An image of codes, taken apart into what is packed.
pub(crate) struct Planes {
    /// One bit a pixel, 1 = measured.
    pub(crate) mask: Vec<u8>,
    /// One byte a block.
    pub(crate) predictors: Vec<u8>,
    /// Zigzag residuals by context; `MAX_SYMBOL` stands for the next escape.
    pub(crate) symbols: [Vec<u8>; CONTEXTS],
    /// Residuals of `MAX_SYMBOL` and above, 3 bytes each.
    pub(crate) escapes: Vec<u8>,
}

/// Number of blocks of an image.
pub(crate) fn block_count(width: usize, height: usize) -> usize {
    width.div_ceil(BLOCK) * height.div_ceil(BLOCK)
}

/// The four neighbours that are known before a pixel.
#[derive(Clone, Copy)]
struct Neighbours {
    left: i32,
    up: i32,
    up_left: i32,
    up_right: i32,
}

impl Neighbours {
    /// Neighbours of pixel `x` in a row being filled; `above` is `None` in the first row.
    #[inline]
    fn of(row: &[u16], above: Option<&[u16]>, x: usize) -> Neighbours {
        match above {
            None => {
                let left = if x > 0 { row[x - 1] as i32 } else { 0 };
                Neighbours { left, up: left, up_left: left, up_right: left }
            }
            Some(above) => {
                let up = above[x] as i32;
                let (left, up_left) = if x > 0 { (row[x - 1] as i32, above[x - 1] as i32) } else { (up, up) };
                let up_right = if x + 1 < above.len() { above[x + 1] as i32 } else { up };
                Neighbours { left, up, up_left, up_right }
            }
        }
    }

    /// What a pixel without measurement is taken for.
    #[inline]
    fn filler(row: &[u16], above: Option<&[u16]>, x: usize) -> u16 {
        if x > 0 { row[x - 1] } else { above.map_or(0, |above| above[0]) }
    }

    #[inline]
    fn predict(&self, predictor: u8) -> i32 {
        let Neighbours { left, up, up_left, up_right } = *self;
        match predictor {
            0 => left,
            1 => up,
            2 => (left + up) >> 1,
            3 => left + up - up_left,
            USUAL => (left + up - up_left).clamp(left.min(up), left.max(up)),
            5 => (left + up_right) >> 1,
            _ => (3 * (left + up) - 2 * up_left) >> 2,
        }
    }

    #[inline]
    fn context(&self) -> usize {
        let activity = (self.left - self.up_left).unsigned_abs()
            + (self.up - self.up_left).unsigned_abs()
            + (self.up_right - self.up).unsigned_abs();
        match activity {
            0 => 0,
            1 => 1,
            2 => 2,
            3..=4 => 3,
            5..=8 => 4,
            9..=16 => 5,
            17..=40 => 6,
            _ => 7,
        }
    }
}

impl Planes {
    /// Takes an image of codes apart.
    pub(crate) fn of(codes: &Image<u16>) -> Planes {
        let (width, height) = (codes.width(), codes.height());
        let mut mask = vec![0u8; (width * height).div_ceil(8)];
        for (i, code) in codes.pixels().iter().enumerate() {
            mask[i / 8] |= u8::from(*code > 0) << (i % 8);
        }
        let filled = filled(codes);
        let predictors = best_predictors(codes, &filled);
        let blocks_across = width.div_ceil(BLOCK);
        let mut symbols: [Vec<u8>; CONTEXTS] = Default::default();
        let mut escapes = Vec::new();
        for y in 0..height {
            let (row, above) = rows(&filled, width, y);
            let chosen = &predictors[y / BLOCK * blocks_across..][..blocks_across];
            for (x, code) in codes.row(y).iter().enumerate() {
                if *code == 0 {
                    continue;
                }
                let neighbours = Neighbours::of(row, above, x);
                let residual = *code as i32 - neighbours.predict(chosen[x / BLOCK]);
                let zigzag = ((residual << 1) ^ (residual >> 31)) as u32;
                let stream = &mut symbols[neighbours.context()];
                if zigzag < MAX_SYMBOL as u32 {
                    stream.push(zigzag as u8);
                } else {
                    stream.push(MAX_SYMBOL);
                    // |residual| < 3 * 65536, so 19 bits hold it.
                    escapes.extend_from_slice(&zigzag.to_le_bytes()[..3]);
                }
            }
        }
        Planes { mask, predictors, symbols, escapes }
    }

    /// Puts the image together again. The mask and the predictors have the size that the image asks for.
    pub(crate) fn into_codes(self, width: usize, height: usize) -> Result<Image<u16>, DepthCodecError> {
        if let Some(bad) = self.predictors.iter().find(|p| **p as usize >= PREDICTORS) {
            return Err(DepthCodecError::Malformed {
                what: "predictor",
                found: *bad as usize,
                expected: PREDICTORS - 1,
            });
        }
        let mut streams: [std::slice::Iter<u8>; CONTEXTS] =
            std::array::from_fn(|context| self.symbols[context].iter());
        let mut escapes = self.escapes.chunks_exact(3);
        let blocks_across = width.div_ceil(BLOCK);
        let missing = |what| DepthCodecError::Truncated { what, needed: 1, left: 0 };
        let mut filled = vec![0u16; width * height];
        for y in 0..height {
            let (before, rest) = filled.split_at_mut(y * width);
            let row = &mut rest[..width];
            let above = (y > 0).then(|| &before[(y - 1) * width..]);
            let chosen = &self.predictors[y / BLOCK * blocks_across..][..blocks_across];
            for x in 0..width {
                if !self.measured(y * width + x) {
                    row[x] = Neighbours::filler(row, above, x);
                    continue;
                }
                let neighbours = Neighbours::of(row, above, x);
                let symbol = *streams[neighbours.context()].next().ok_or_else(|| missing("residuals"))?;
                let zigzag = if symbol < MAX_SYMBOL {
                    symbol as u32
                } else {
                    let bytes = escapes.next().ok_or_else(|| missing("escapes"))?;
                    u32::from_le_bytes([bytes[0], bytes[1], bytes[2], 0])
                };
                let residual = (zigzag >> 1) as i32 ^ -((zigzag & 1) as i32);
                let code = neighbours.predict(chosen[x / BLOCK]) + residual;
                row[x] =
                    u16::try_from(code).ok().filter(|code| *code > 0).ok_or(DepthCodecError::Malformed {
                        what: "depth code",
                        found: code.max(0) as usize,
                        expected: 65535,
                    })?;
            }
        }
        let left = streams.iter().map(|s| s.len()).sum::<usize>() + escapes.len() + escapes.remainder().len();
        if left > 0 {
            return Err(DepthCodecError::Malformed {
                what: "number of residuals left over",
                found: left,
                expected: 0,
            });
        }
        for (i, code) in filled.iter_mut().enumerate() {
            *code *= u16::from(self.measured(i));
        }
        Ok(Image::from_pixels(width, height, filled).expect("one code per pixel"))
    }

    #[inline]
    fn measured(&self, pixel: usize) -> bool {
        self.mask[pixel / 8] >> (pixel % 8) & 1 == 1
    }
}

/// The codes with holes filled from the left (in the first column: from above).
fn filled(codes: &Image<u16>) -> Vec<u16> {
    let width = codes.width();
    let mut filled = codes.pixels().to_vec();
    for y in 0..codes.height() {
        let (before, rest) = filled.split_at_mut(y * width);
        let row = &mut rest[..width];
        let above = (y > 0).then(|| &before[(y - 1) * width..]);
        for x in 0..width {
            if row[x] == 0 {
                row[x] = Neighbours::filler(row, above, x);
            }
        }
    }
    filled
}

fn rows(filled: &[u16], width: usize, y: usize) -> (&[u16], Option<&[u16]>) {
    let above = (y > 0).then(|| &filled[(y - 1) * width..y * width]);
    (&filled[y * width..(y + 1) * width], above)
}

/// For every block the predictor whose residuals take the fewest bits, estimated as log2(1 + |residual|).
fn best_predictors(codes: &Image<u16>, filled: &[u16]) -> Vec<u8> {
    let (width, height) = (codes.width(), codes.height());
    // Sixteenths of a bit for |residual| 0..=255; a larger one costs as 255.
    let bits: [u32; 256] = std::array::from_fn(|r| ((1.0 + r as f64).log2() * 16.0) as u32);
    let blocks_across = width.div_ceil(BLOCK);
    let mut best = Vec::with_capacity(block_count(width, height));
    let mut costs = vec![[0u32; PREDICTORS]; blocks_across];
    for top in (0..height).step_by(BLOCK) {
        costs.fill([0; PREDICTORS]);
        for y in top..(top + BLOCK).min(height) {
            let (row, above) = rows(filled, width, y);
            for (x, code) in codes.row(y).iter().enumerate() {
                if *code == 0 {
                    continue;
                }
                let neighbours = Neighbours::of(row, above, x);
                let cost = &mut costs[x / BLOCK];
                for predictor in 0..PREDICTORS {
                    let residual = *code as i32 - neighbours.predict(predictor as u8);
                    cost[predictor] += bits[residual.unsigned_abs().min(255) as usize];
                }
            }
        }
        best.extend(costs.iter().map(|cost| {
            let switched = |p: u8| cost[p as usize] + if p == USUAL { 0 } else { SWITCH_COST };
            (0..PREDICTORS as u8).min_by_key(|p| switched(*p)).expect("there are predictors")
        }));
    }
    best
}
