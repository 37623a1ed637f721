//! One row of an alignment's normal equations. Pixels that found a partner are gathered into columns first; the sums
//! then run over 16 of them at a time.

use multiversion::multiversion;

/// Pixels that are summed at once.
const LANES: usize = 16;
/// Upper triangle of a 6x6 matrix.
pub const TRIANGLE: usize = 21;

/// Matched pixels of one row, as columns. Lengths are rounded up to whole lanes with pixels of no weight.
#[derive(Default)]
pub struct Matches {
    /// The pixel's point in the reference, metres.
    pub point: [Vec<f32>; 3],
    /// Normal of the reference there.
    pub normal: [Vec<f32>; 3],
    /// 1 / sigma of the distance to the plane, 1/m.
    pub inv_sigma: Vec<f32>,
    /// Distance to the plane, in units of sigma.
    pub distance: Vec<f32>,
    /// Derivative of the reference's intensity by the point, 1/m.
    pub slope: [Vec<f32>; 3],
    /// Reference minus own intensity, own brightness corrected.
    pub difference: Vec<f32>,
}

impl Matches {
    fn columns(&mut self) -> [&mut Vec<f32>; 12] {
        let [px, py, pz] = &mut self.point;
        let [nx, ny, nz] = &mut self.normal;
        let [sx, sy, sz] = &mut self.slope;
        [px, py, pz, nx, ny, nz, &mut self.inv_sigma, &mut self.distance, sx, sy, sz, &mut self.difference]
    }

    /// Forgets all pixels.
    pub fn clear(&mut self) {
        self.columns().into_iter().for_each(Vec::clear);
    }

    /// Number of pixels.
    pub fn len(&self) -> usize {
        self.distance.len()
    }

    fn pad(&mut self) {
        let padded = self.len().next_multiple_of(LANES);
        self.columns().into_iter().for_each(|column| column.resize(padded, 0.0));
    }
}

/// How residuals are weighed.
#[derive(Clone, Copy)]
pub struct Weights {
    /// 1 / scale of the distances, which are in units of sigma.
    pub inv_geometric: f32,
    /// 1 / scale of the intensity differences.
    pub inv_photometric: f32,
    /// Weight of a photometric residual against a geometric one.
    pub photometric: f32,
    /// Degrees of freedom of the t-distribution that residuals in units of the scales follow.
    pub freedom: f32,
}

/// Sums over a row: `J^T W J` (upper triangle, row by row) and `J^T W r`, both kinds of residuals together.
pub struct RowSums {
    /// Upper triangle.
    pub hessian: [f32; TRIANGLE],
    /// By the pose, perturbed on the reference's side.
    pub gradient: [f32; 6],
}

/// Sums up a row. The columns are padded to whole lanes.
pub fn sum(matches: &mut Matches, weights: &Weights) -> RowSums {
    let count = matches.len();
    matches.pad();
    sum_lanes(matches, count, weights)
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn sum_lanes(m: &Matches, count: usize, weights: &Weights) -> RowSums {
    let inv_freedom = 1.0 / weights.freedom;
    let mut hessian = [[0.0f32; LANES]; TRIANGLE];
    let mut gradient = [[0.0f32; LANES]; 6];
    for begin in (0..m.len()).step_by(LANES) {
        let lanes = |column: &Vec<f32>| -> [f32; LANES] {
            column[begin..begin + LANES].try_into().expect("columns are padded to whole lanes")
        };
        let live: [f32; LANES] = std::array::from_fn(|i| if begin + i < count { 1.0 } else { 0.0 });
        let [px, py, pz] = [lanes(&m.point[0]), lanes(&m.point[1]), lanes(&m.point[2])];
        let (inv_sigma, distance) = (lanes(&m.inv_sigma), lanes(&m.distance));
        let difference = lanes(&m.difference);
        // Point to plane, in units of sigma.
        let [nx, ny, nz] = [lanes(&m.normal[0]), lanes(&m.normal[1]), lanes(&m.normal[2])];
        let mut j = [[0.0f32; LANES]; 6];
        let mut weight = [0.0f32; LANES];
        for i in 0..LANES {
            let s = inv_sigma[i];
            j[0][i] = nx[i] * s;
            j[1][i] = ny[i] * s;
            j[2][i] = nz[i] * s;
            j[3][i] = (py[i] * nz[i] - pz[i] * ny[i]) * s;
            j[4][i] = (pz[i] * nx[i] - px[i] * nz[i]) * s;
            j[5][i] = (px[i] * ny[i] - py[i] * nx[i]) * s;
            let scaled = distance[i].abs() * weights.inv_geometric;
            let robust = 1.0 / (1.0 + scaled * scaled * inv_freedom);
            weight[i] = live[i] * robust * weights.inv_geometric * weights.inv_geometric;
        }
        add(&j, &distance, &weight, &mut hessian, &mut gradient);
        // Photometric.
        let [dx, dy, dz] = [lanes(&m.slope[0]), lanes(&m.slope[1]), lanes(&m.slope[2])];
        for i in 0..LANES {
            j[0][i] = dx[i];
            j[1][i] = dy[i];
            j[2][i] = dz[i];
            j[3][i] = py[i] * dz[i] - pz[i] * dy[i];
            j[4][i] = pz[i] * dx[i] - px[i] * dz[i];
            j[5][i] = px[i] * dy[i] - py[i] * dx[i];
            let scaled = difference[i].abs() * weights.inv_photometric;
            let robust = 1.0 / (1.0 + scaled * scaled * inv_freedom);
            let unit = weights.inv_photometric * weights.inv_photometric * weights.photometric;
            weight[i] = live[i] * robust * unit;
        }
        add(&j, &difference, &weight, &mut hessian, &mut gradient);
    }
    RowSums {
        hessian: hessian.map(|lanes| lanes.iter().sum()),
        gradient: gradient.map(|lanes| lanes.iter().sum()),
    }
}

#[inline(always)]
fn add(
    j: &[[f32; LANES]; 6],
    r: &[f32; LANES],
    weight: &[f32; LANES],
    hessian: &mut [[f32; LANES]; TRIANGLE],
    gradient: &mut [[f32; LANES]; 6],
) {
    let mut k = 0;
    for a in 0..6 {
        let mut weighted = [0.0f32; LANES];
        for i in 0..LANES {
            weighted[i] = weight[i] * j[a][i];
            gradient[a][i] += weighted[i] * r[i];
        }
        for b in a..6 {
            for i in 0..LANES {
                hessian[k][i] += weighted[i] * j[b][i];
            }
            k += 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_agree_with_one_pixel_at_a_time_whatever_the_number_of_pixels() {
        let value = |k: usize, i: usize| ((k * 37 + i * 11) % 23) as f32 * 0.1 - 1.0;
        let weights = Weights { inv_geometric: 1.5, inv_photometric: 4.0, photometric: 0.25, freedom: 5.0 };
        for count in [1, 15, 16, 17, 50] {
            let mut m = Matches::default();
            for i in 0..count {
                m.columns().into_iter().enumerate().for_each(|(k, column)| column.push(value(k, i)));
            }
            let (mut hessian, mut gradient) = ([0.0f64; TRIANGLE], [0.0f64; 6]);
            for i in 0..count {
                let v = |k| value(k, i) as f64;
                let moment = |a: usize| {
                    [
                        v(1) * v(a + 2) - v(2) * v(a + 1),
                        v(2) * v(a) - v(0) * v(a + 2),
                        v(0) * v(a + 1) - v(1) * v(a),
                    ]
                };
                for (first, scale, r, inv, unit) in [(3, v(6), v(7), 1.5, 1.0), (8, 1.0, v(11), 4.0, 0.25)] {
                    let torque = moment(first);
                    let j: Vec<f64> = (0..3)
                        .map(|k| v(first + k) * scale)
                        .chain(torque.iter().map(|t| t * scale))
                        .collect();
                    let scaled = r.abs() * inv;
                    let weight = 5.0 / (5.0 + scaled * scaled) * inv * inv * unit;
                    let mut k = 0;
                    for a in 0..6 {
                        gradient[a] += weight * j[a] * r;
                        for b in a..6 {
                            hessian[k] += weight * j[a] * j[b];
                            k += 1;
                        }
                    }
                }
            }
            let found = sum(&mut m, &weights);
            for (f, t) in found.hessian.iter().zip(hessian).chain(found.gradient.iter().zip(gradient)) {
                assert!((*f as f64 - t).abs() < 1e-4 * (1.0 + t.abs()), "{count} pixels: {f} {t}");
            }
        }
    }
}
