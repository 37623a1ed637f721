//! Vectors of numbers, as many lanes as the processor has: 16 with AVX-512, 8 with AVX2, 4 with NEON, 1 else.
//!
//! The kernels are written once over [`Simd`]; [`pulp::Arch`] picks the instructions at run time.

use pulp::Simd;
use std::ops::{Add, Div, Mul, Sub};

/// One number per lane.
#[derive(Clone, Copy)]
pub(crate) struct Lanes<S: Simd> {
    simd: S,
    values: S::f32s,
}

/// One flag per lane.
#[derive(Clone, Copy)]
pub(crate) struct Mask<S: Simd> {
    simd: S,
    flags: S::m32s,
}

impl<S: Simd> Lanes<S> {
    #[inline(always)]
    pub fn splat(simd: S, value: f32) -> Self {
        Lanes { simd, values: simd.splat_f32s(value) }
    }

    /// The `part`-th vector of a longer row.
    #[inline(always)]
    pub fn load(simd: S, row: &[f32], part: usize) -> Self {
        Lanes { simd, values: S::as_simd_f32s(row).0[part] }
    }

    #[inline(always)]
    pub fn store(self, row: &mut [f32], part: usize) {
        S::as_mut_simd_f32s(row).0[part] = self.values;
    }

    /// `self * factor + term`, rounded once where the processor can.
    #[inline(always)]
    pub fn mul_add(self, factor: Self, term: Self) -> Self {
        Lanes { simd: self.simd, values: self.simd.mul_add_e_f32s(self.values, factor.values, term.values) }
    }

    /// `term - self * factor`.
    #[inline(always)]
    pub fn neg_mul_add(self, factor: Self, term: Self) -> Self {
        let values = self.simd.negate_mul_add_e_f32s(self.values, factor.values, term.values);
        Lanes { simd: self.simd, values }
    }

    #[inline(always)]
    pub fn min(self, other: Self) -> Self {
        Lanes { simd: self.simd, values: self.simd.min_f32s(self.values, other.values) }
    }

    #[inline(always)]
    pub fn max(self, other: Self) -> Self {
        Lanes { simd: self.simd, values: self.simd.max_f32s(self.values, other.values) }
    }

    #[inline(always)]
    pub fn abs(self) -> Self {
        Lanes { simd: self.simd, values: self.simd.abs_f32s(self.values) }
    }

    #[inline(always)]
    pub fn sqrt(self) -> Self {
        Lanes { simd: self.simd, values: self.simd.sqrt_f32s(self.values) }
    }

    /// False for NaN, as every comparison.
    #[inline(always)]
    pub fn less(self, other: Self) -> Mask<S> {
        Mask { simd: self.simd, flags: self.simd.less_than_f32s(self.values, other.values) }
    }

    #[inline(always)]
    pub fn at_most(self, other: Self) -> Mask<S> {
        Mask { simd: self.simd, flags: self.simd.less_than_or_equal_f32s(self.values, other.values) }
    }

    /// Sum of all lanes, pairwise, in an order that depends on their number alone.
    #[inline(always)]
    pub fn sum(self) -> f32 {
        self.simd.reduce_sum_f32s(self.values)
    }

    /// `2^t` for `t` in -120..=0 (smaller counts as -120), relative error under 3e-6: a polynomial for the
    /// fraction of the exponent (Cephes' exp2f), and the whole part written into the exponent's bits.
    #[inline(always)]
    pub fn exp2(self) -> Self {
        let simd = self.simd;
        let number = |value: f32| Lanes::splat(simd, value);
        let t = self.max(number(-120.0));
        // Added, this leaves the nearest whole number in the lowest bits.
        let magic = number(12_582_912.0);
        let shifted = t + magic;
        let f = t - (shifted - magic);
        let p = number(1.535_336_7e-4);
        let p = p.mul_add(f, number(1.339_887_4e-3));
        let p = p.mul_add(f, number(9.618_438e-3));
        let p = p.mul_add(f, number(5.550_332_5e-2));
        let p = p.mul_add(f, number(2.402_264_8e-1));
        let p = p.mul_add(f, number(6.931_472e-1));
        let p = p.mul_add(f, number(1.0));
        let whole = simd.wrapping_dyn_shl_u32s(simd.transmute_u32s_f32s(shifted.values), simd.splat_u32s(23));
        let bits = simd.add_u32s(simd.transmute_u32s_f32s(p.values), whole);
        Lanes { simd, values: simd.transmute_f32s_u32s(bits) }
    }
}

impl<S: Simd> Mask<S> {
    #[inline(always)]
    pub fn and(self, other: Self) -> Self {
        Mask { simd: self.simd, flags: self.simd.and_m32s(self.flags, other.flags) }
    }

    #[inline(always)]
    pub fn or(self, other: Self) -> Self {
        Mask { simd: self.simd, flags: self.simd.or_m32s(self.flags, other.flags) }
    }

    #[inline(always)]
    pub fn select(self, yes: Lanes<S>, no: Lanes<S>) -> Lanes<S> {
        Lanes { simd: self.simd, values: self.simd.select_f32s(self.flags, yes.values, no.values) }
    }

    /// True in any lane.
    #[inline(always)]
    pub fn any(self) -> bool {
        self.simd.first_true_m32s(self.flags) < S::F32_LANES
    }
}

macro_rules! operator {
    ($trait:ident, $method:ident, $function:ident) => {
        impl<S: Simd> $trait for Lanes<S> {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                Lanes { simd: self.simd, values: self.simd.$function(self.values, other.values) }
            }
        }
    };
}

operator!(Add, add, add_f32s);
operator!(Sub, sub, sub_f32s);
operator!(Mul, mul, mul_f32s);
operator!(Div, div, div_f32s);

#[cfg(test)]
mod tests {
    use super::*;
    use pulp::{Arch, WithSimd};

    struct Exp2<'a>(&'a [f32; 16]);

    impl WithSimd for Exp2<'_> {
        type Output = [f32; 16];
        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) -> [f32; 16] {
            let mut out = [0.0; 16];
            for part in 0..16 / S::F32_LANES {
                Lanes::load(simd, self.0, part).exp2().store(&mut out, part);
            }
            out
        }
    }

    #[test]
    fn relative_error_of_exp2_is_under_3e_6_on_every_instruction_set() {
        for arch in crate::architectures() {
            let mut worst = 0.0f64;
            for i in 0..40_000 {
                let t: [f32; 16] = std::array::from_fn(|k| -(i as f32 * 16.0 + k as f32) * 1.5e-4);
                let found = arch.dispatch(Exp2(&t));
                for k in 0..16 {
                    let truth = (t[k] as f64).exp2();
                    worst = worst.max((found[k] as f64 - truth).abs() / truth);
                }
            }
            assert!(worst < 3e-6, "{arch:?}: {worst}");
        }
        let tiny = Arch::new().dispatch(Exp2(&[-1e30; 16]));
        assert!(tiny.iter().all(|v| *v >= 0.0 && *v < 1e-30));
    }
}
