//! `exp(-x)` that vectorises.

/// `exp(-x)` for `x` in 0..80, relative error under 3e-6: a polynomial for the fraction of the exponent of
/// two (Cephes' exp2f), and the whole part written into the exponent's bits.
#[inline(always)]
pub fn exp_neg(x: f32) -> f32 {
    let t = (-x * std::f32::consts::LOG2_E).max(-120.0);
    let whole = (t + 0.5).floor();
    let f = t - whole;
    let p = 1.535_336_7e-4_f32;
    let p = p * f + 1.339_887_4e-3;
    let p = p * f + 9.618_437_4e-3;
    let p = p * f + 5.550_332_5e-2;
    let p = p * f + 2.402_264_8e-1;
    let p = p * f + 6.931_472e-1;
    let p = p * f + 1.0;
    p * f32::from_bits(((whole as i32 + 127) << 23) as u32)
}

#[cfg(test)]
mod tests {
    use super::exp_neg;

    #[test]
    fn relative_error_is_under_3e_6() {
        let mut worst = 0.0f64;
        for i in 0..200_000 {
            let x = i as f32 * 1e-4;
            let truth = (-(x as f64)).exp();
            worst = worst.max((exp_neg(x) as f64 - truth).abs() / truth);
        }
        assert!(worst < 3e-6, "{worst}");
    }
}
