//! Run lengths of zeros, inside a stream of small symbols.
//!
//! In the packed stream bytes 0 and 1 are the digits of a run's length in bijective base 2 (digit values 1 and 2),
//! lowest first, as in bzip2; byte b >= 2 is symbol b - 1.

use crate::DepthCodecError;

/// The largest symbol.
pub(crate) const MAX_SYMBOL: u8 = 254;

/// Replaces runs of zeros by their lengths. Never longer than its input.
pub(crate) fn pack(symbols: &[u8]) -> Vec<u8> {
    let mut packed = Vec::with_capacity(symbols.len() / 2);
    let mut zeros = 0usize;
    for symbol in symbols {
        if *symbol == 0 {
            zeros += 1;
        } else {
            push_run(&mut packed, std::mem::take(&mut zeros));
            packed.push(*symbol + 1);
        }
    }
    push_run(&mut packed, zeros);
    packed
}

fn push_run(packed: &mut Vec<u8>, mut zeros: usize) {
    while zeros > 0 {
        let digit = if zeros % 2 == 1 { 1 } else { 2 };
        packed.push(digit as u8 - 1);
        zeros = (zeros - digit) / 2;
    }
}

/// The symbols again; at most `max` of them.
pub(crate) fn unpack(packed: &[u8], max: usize) -> Result<Vec<u8>, DepthCodecError> {
    let too_long = |found| DepthCodecError::Malformed { what: "run of residuals", found, expected: max };
    let mut symbols = Vec::new();
    let mut digits = packed.iter().copied().peekable();
    while let Some(byte) = digits.next() {
        if byte >= 2 {
            symbols.push(byte - 1);
        } else {
            let mut zeros = byte as usize + 1;
            let mut place = 1usize;
            while let Some(digit) = digits.next_if(|b| *b < 2) {
                place *= 2;
                zeros += place * (digit as usize + 1);
                if zeros > max {
                    return Err(too_long(zeros));
                }
            }
            if symbols.len() + zeros > max {
                return Err(too_long(symbols.len() + zeros));
            }
            symbols.resize(symbols.len() + zeros, 0);
        }
        if symbols.len() > max {
            return Err(too_long(symbols.len()));
        }
    }
    Ok(symbols)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn unpacking_gives_back_what_was_packed(symbols in prop::collection::vec(prop_oneof![3 => Just(0u8), 1 => 0..=MAX_SYMBOL], 0..400)) {
            let packed = pack(&symbols);
            prop_assert!(packed.len() <= symbols.len());
            prop_assert_eq!(unpack(&packed, symbols.len()).unwrap(), symbols);
        }
    }

    #[test]
    fn a_run_longer_than_the_image_is_refused_before_it_is_made() {
        assert!(unpack(&[1; 60], 1000).is_err());
        assert!(unpack(&[1; 4000], usize::MAX >> 8).is_err());
        assert_eq!(unpack(&[1, 1], 6).unwrap(), vec![0; 6]);
        assert!(unpack(&[1, 1], 5).is_err());
    }
}
