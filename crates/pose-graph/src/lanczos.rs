//! The largest eigenvalue of a symmetric operator, by Lanczos' iteration with full reorthogonalisation.

use nalgebra::{DMatrix, SymmetricEigen};

/// When to stop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct LanczosLimits {
    /// Most applications of the operator.
    pub steps: usize,
    /// Stop when the residual of the leading pair is below this share of its eigenvalue.
    pub relative: f64,
}

/// The largest eigenvalue of `apply` on vectors of length `n`; from below, as far as the limits let it. The start is
/// always the same. Zero for an empty operator.
pub(crate) fn largest_eigenvalue(
    n: usize,
    limits: &LanczosLimits,
    mut apply: impl FnMut(&[f64]) -> Vec<f64>,
) -> f64 {
    let mut basis: Vec<Vec<f64>> = Vec::new();
    let (mut alpha, mut beta): (Vec<f64>, Vec<f64>) = (Vec::new(), Vec::new());
    let mut next = start(n);
    let mut found = 0.0;
    while basis.len() < limits.steps.min(n) {
        let mut image = apply(&next);
        alpha.push(dot(&image, &next));
        basis.push(next);
        // Twice is enough (Kahan, Parlett).
        for _ in 0..2 {
            for v in &basis {
                let along = dot(&image, v);
                image.iter_mut().zip(v).for_each(|(x, v)| *x -= along * v);
            }
        }
        let norm = dot(&image, &image).sqrt();
        let (value, last) = leading_pair(&alpha, &beta);
        found = value;
        if !(norm > 0.0) || !(norm * last > limits.relative * value.abs()) {
            break;
        }
        image.iter_mut().for_each(|x| *x /= norm);
        beta.push(norm);
        next = image;
    }
    found
}

/// Largest eigenvalue of the tridiagonal matrix, and the size of its vector's last component.
fn leading_pair(alpha: &[f64], beta: &[f64]) -> (f64, f64) {
    let k = alpha.len();
    let tridiagonal = DMatrix::from_fn(k, k, |row, column| match row.abs_diff(column) {
        0 => alpha[row],
        1 => beta[row.min(column)],
        _ => 0.0,
    });
    let eigen = SymmetricEigen::new(tridiagonal);
    let best = eigen.eigenvalues.imax();
    (eigen.eigenvalues[best], eigen.eigenvectors[(k - 1, best)].abs())
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

/// A unit vector with a part in every direction that one meets.
fn start(n: usize) -> Vec<f64> {
    let mut state = 0u64;
    let mut v: Vec<f64> = (0..n)
        .map(|_| {
            state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
            let z = (state ^ (state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            ((z ^ (z >> 27)) >> 11) as f64 / (1u64 << 53) as f64 - 0.5
        })
        .collect();
    let norm = dot(&v, &v).sqrt();
    v.iter_mut().for_each(|x| *x /= norm);
    v
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_largest_of_known_eigenvalues_is_found_also_if_it_is_double_or_negative() {
        let limits = LanczosLimits { steps: 60, relative: 1e-10 };
        for values in [vec![1.0, -9.0, 4.0, 7.5, 7.5, 0.0], vec![-3.0, -2.0, -11.0], vec![5.0]] {
            let wanted = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let found = largest_eigenvalue(values.len(), &limits, |v| {
                v.iter().zip(&values).map(|(x, l)| x * l).collect()
            });
            assert!((found - wanted).abs() < 1e-9, "{found} instead of {wanted}");
        }
    }
}
