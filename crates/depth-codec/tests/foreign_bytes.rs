//! Bytes from anywhere: an error, never a panic, never more memory than the limit allows.

use coma_depth_codec::{
    DepthCodecError, Limits, Quantisation, Settings, decode, decode_u16, encode, encode_u16,
};
use coma_frame::{DepthNoise, Image};
use proptest::prelude::*;

const LIMITS: Limits = Limits { max_pixels: 64 * 64 };

fn samples() -> Vec<Vec<u8>> {
    let depth_m =
        Image::from_fn(33, 21, |x, y| if (x * y) % 11 == 3 { 0.0 } else { 1.0 + (x * y % 50) as f32 * 0.02 });
    let jumps = Image::from_fn(33, 21, |x, y| if (x + y) % 3 == 0 { 60_000u16 } else { 500 });
    let noise = Quantisation::NoiseProportional { noise: DepthNoise::default(), fraction: 0.5 };
    [Quantisation::Linear12 { near_m: 0.0, far_m: 10.0 }, noise, Settings::default().quantisation]
        .map(|quantisation| encode(&depth_m, &Settings { quantisation, zstd_level: 3 }).unwrap())
        .into_iter()
        .chain([encode_u16(&jumps, 1000.0, 3).unwrap()])
        .collect()
}

/// The same FNV-1a as the codec's: bytes with it get past the checksum to what lies behind.
fn with_checksum(mut body: Vec<u8>) -> Vec<u8> {
    let hash = body.iter().fold(0x811c_9dc5u32, |h, b| (h ^ *b as u32).wrapping_mul(0x0100_0193));
    body.extend_from_slice(&hash.to_le_bytes());
    body
}

#[test]
fn every_truncation_is_an_error() {
    for bytes in samples() {
        for end in 0..bytes.len() {
            assert!(decode(&bytes[..end], LIMITS).is_err(), "{end} of {}", bytes.len());
            // Also with a checksum that fits the shorter bytes.
            if end >= 4 && end < bytes.len() - 4 {
                assert!(decode(&with_checksum(bytes[..end].to_vec()), LIMITS).is_err());
            }
        }
    }
}

#[test]
fn every_flipped_bit_is_an_error() {
    for bytes in samples() {
        for bit in 0..bytes.len() * 8 {
            let mut flipped = bytes.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            assert!(decode(&flipped, LIMITS).is_err(), "bit {bit}");
        }
    }
}

#[test]
fn a_flipped_bit_behind_a_right_checksum_never_panics() {
    for bytes in samples() {
        for bit in 0..(bytes.len() - 4) * 8 {
            let mut flipped = bytes[..bytes.len() - 4].to_vec();
            flipped[bit / 8] ^= 1 << (bit % 8);
            if let Ok(decoded) = decode(&with_checksum(flipped), LIMITS) {
                assert!(decoded.depth_m.pixels().iter().all(|z| *z >= 0.0));
            }
        }
    }
}

#[test]
fn an_image_over_the_limit_is_refused_by_its_header() {
    let bytes = encode(&Image::filled(65, 64, 1.0f32), &Settings::default()).unwrap();
    assert!(matches!(
        decode(&bytes, LIMITS),
        Err(DepthCodecError::TooLarge { width: 65, height: 64, max_pixels: 4096 })
    ));
    // Sides whose product overflows 32 bits.
    let mut header = b"CDPT\x01\x00".to_vec();
    header.extend_from_slice(&[0xff; 8]);
    header.extend_from_slice(&1000f32.to_le_bytes());
    assert!(matches!(decode(&with_checksum(header), LIMITS), Err(DepthCodecError::TooLarge { .. })));
}

#[test]
fn a_section_may_not_be_longer_than_its_image() {
    let mut body = b"CDPT\x01\x00".to_vec();
    body.extend_from_slice(&8u32.to_le_bytes());
    body.extend_from_slice(&8u32.to_le_bytes());
    body.extend_from_slice(&1000f32.to_le_bytes());
    body.extend_from_slice(&u32::MAX.to_le_bytes());
    body.extend_from_slice(&0u32.to_le_bytes());
    let error = decode(&with_checksum(body), LIMITS).unwrap_err();
    assert!(matches!(error, DepthCodecError::Malformed { what: "mask", expected: 8, .. }), "{error}");
}

#[test]
fn another_format_and_a_later_version_are_named() {
    assert!(matches!(decode(b"\x89PNG\r\n\x1a\n", LIMITS), Err(DepthCodecError::NotThisCodec)));
    let mut bytes = samples().remove(0);
    bytes[4] = 9;
    assert!(matches!(decode(&bytes, LIMITS), Err(DepthCodecError::Version { found: 9 })));
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 500, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn random_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        let _ = decode(&bytes, LIMITS);
        let mut body = b"CDPT\x01".to_vec();
        body.extend_from_slice(&bytes);
        let _ = decode_u16(&with_checksum(body), LIMITS);
    }

    #[test]
    fn several_changed_bytes_behind_a_right_checksum_never_panic(sample in 0usize..4, changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6)) {
        let mut bytes = samples().remove(sample);
        bytes.truncate(bytes.len() - 4);
        for (at, value) in changes {
            let at = at.index(bytes.len());
            bytes[at] = value;
        }
        let _ = decode(&with_checksum(bytes), LIMITS);
    }
}
