//! What comes out of the codec, for any depth that goes in.

use coma_depth_codec::{
    DepthCodecError, ErrorBound, Limits, Quantisation, Settings, decode, decode_u16, encode, encode_u16,
};
use coma_frame::{DepthNoise, Image};
use proptest::prelude::*;

const LINEAR12: Quantisation = Quantisation::Linear12 { near_m: 0.0, far_m: 10.0 };
const NOISE: Quantisation = Quantisation::NoiseProportional {
    noise: DepthNoise { base_m: 0.001, quadratic_per_m: 0.0019 },
    fraction: 0.25,
};

fn settings(quantisation: Quantisation) -> Settings {
    Settings { quantisation, ..Settings::default() }
}

/// A wall with a box before it, holes, and a little noise.
fn scene(width: usize, height: usize) -> Image<f32> {
    Image::from_fn(width, height, |x, y| {
        let hash = (x * 7919 + y * 104_729) % 97;
        if hash < 9 || (x / 5 + y / 7) % 13 == 0 {
            return 0.0;
        }
        let wall = 2.0 + 0.003 * x as f32 + 0.001 * y as f32;
        let z = if (x / 20) % 3 == 1 && (y / 16) % 2 == 1 { 0.9 } else { wall };
        z + 0.0004 * (hash as f32 - 50.0) / 50.0
    })
}

fn assert_within_bound(depth_m: &Image<f32>, quantisation: Quantisation) {
    let decoded = decode(&encode(depth_m, &settings(quantisation)).unwrap(), Limits::default()).unwrap();
    for (z, back) in depth_m.pixels().iter().zip(decoded.depth_m.pixels()) {
        if *z > 0.0 {
            let bound = decoded.max_error.at_m(*z);
            assert!((z - back).abs() <= bound && *back > 0.0, "{z} became {back}, bound {bound}");
        } else {
            assert_eq!(*back, 0.0);
        }
    }
}

#[test]
fn every_pixel_is_within_the_bound_that_the_header_states() {
    let depth_m = scene(123, 77);
    for quantisation in [LINEAR12, NOISE, Settings::default().quantisation] {
        assert_within_bound(&depth_m, quantisation);
    }
}

#[test]
fn steps_in_proportion_to_noise_are_smaller_than_noise_and_not_all_alike() {
    let depth_m = scene(123, 77);
    let decoded = decode(&encode(&depth_m, &settings(NOISE)).unwrap(), Limits::default()).unwrap();
    assert!(matches!(decoded.max_error, ErrorBound::Noise { fraction: 0.25, .. }));
    assert!(decoded.max_error.at_m(4.0) > 5.0 * decoded.max_error.at_m(1.0));
    assert_ne!(decoded.depth_m, depth_m);
}

#[test]
fn depth_in_whole_units_comes_back_bit_by_bit() {
    let depth_m = scene(64, 48).map(|z| (z * 5000.0).round() / 5000.0);
    let quantisation = Quantisation::Lossless16 { units_per_metre: 5000.0 };
    let decoded = decode(&encode(&depth_m, &settings(quantisation)).unwrap(), Limits::default()).unwrap();
    assert_eq!(decoded.depth_m, depth_m);
}

#[test]
fn what_cannot_be_held_becomes_no_measurement() {
    let odd = [f32::NAN, f32::INFINITY, -1.0, 0.0, 10.5, 0.3, 4.0, -f32::INFINITY];
    let depth_m = Image::from_pixels(8, 1, odd.to_vec()).unwrap();
    let quantisation = Quantisation::Linear12 { near_m: 0.5, far_m: 10.0 };
    let decoded = decode(&encode(&depth_m, &settings(quantisation)).unwrap(), Limits::default()).unwrap();
    let measured: Vec<_> = decoded.depth_m.pixels().iter().map(|z| *z > 0.0).collect();
    assert_eq!(measured, [false, false, false, false, false, false, true, false]);
}

#[test]
fn an_image_without_any_measurement_is_small_and_comes_back() {
    let depth_m = Image::filled(640, 480, 0.0f32);
    for quantisation in [LINEAR12, NOISE, Settings::default().quantisation] {
        let bytes = encode(&depth_m, &settings(quantisation)).unwrap();
        assert!(bytes.len() < 400, "{}", bytes.len());
        assert_eq!(decode(&bytes, Limits::default()).unwrap().depth_m, depth_m);
    }
}

#[test]
fn a_flat_wall_is_much_smaller_than_its_raw_form() {
    let depth = Image::from_fn(640, 480, |x, y| 1500 + (x / 2 + y / 3) as u16);
    let bytes = encode_u16(&depth, 1000.0, 3).unwrap();
    assert!(bytes.len() < 640 * 480 * 2 / 50, "{}", bytes.len());
}

#[test]
fn settings_out_of_range_are_named() {
    let depth_m = scene(16, 16);
    let refused = |quantisation, zstd_level| {
        encode(&depth_m, &Settings { quantisation, zstd_level }).unwrap_err().to_string()
    };
    assert!(refused(Quantisation::Lossless16 { units_per_metre: 0.0 }, 3).contains("units_per_metre is 0"));
    assert!(refused(Quantisation::Linear12 { near_m: 2.0, far_m: 1.0 }, 3).contains("far_m is 1"));
    assert!(refused(Quantisation::Linear12 { near_m: f32::NAN, far_m: 1.0 }, 3).contains("near_m is NaN"));
    let noise = DepthNoise { base_m: -1.0, quadratic_per_m: 0.0 };
    assert!(
        refused(Quantisation::NoiseProportional { noise, fraction: 0.5 }, 3).contains("noise.base_m is -1")
    );
    assert!(refused(LINEAR12, 40).contains("zstd_level is 40"));
    let empty = Image::from_pixels(0, 5, Vec::new()).unwrap();
    assert!(matches!(
        encode(&empty, &settings(LINEAR12)),
        Err(DepthCodecError::Size { width: 0, height: 5 })
    ));
}

#[test]
fn a_quantised_image_has_no_lossless_form() {
    let bytes = encode(&scene(16, 16), &settings(LINEAR12)).unwrap();
    assert!(matches!(decode_u16(&bytes, Limits::default()), Err(DepthCodecError::NotLossless)));
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]

    /// Random values are the worst case: every residual escapes.
    #[test]
    fn any_16_bit_image_comes_back(width in 1usize..40, height in 1usize..40, values in prop::collection::vec(prop_oneof![Just(0u16), Just(65535u16), any::<u16>(), 1000u16..1010], 1..1600)) {
        let depth = Image::from_fn(width, height, |x, y| values[(y * width + x) % values.len()]);
        let bytes = encode_u16(&depth, 1000.0, 1).unwrap();
        let (back, units_per_metre) = decode_u16(&bytes, Limits::default()).unwrap();
        prop_assert_eq!(back, depth);
        prop_assert_eq!(units_per_metre, 1000.0);
    }

    #[test]
    fn any_depth_stays_within_its_bound(width in 1usize..30, height in 1usize..30, values in prop::collection::vec(0.01f32..10.0, 1..900)) {
        let depth_m = Image::from_fn(width, height, |x, y| values[(y * width + x) % values.len()]);
        for quantisation in [LINEAR12, NOISE] {
            assert_within_bound(&depth_m, quantisation);
        }
    }
}
