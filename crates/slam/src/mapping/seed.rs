//! New surfels from pixels: surface-fitting initialisation (eq. 6 to 8 of the CoMA-SLAM paper).

use super::even::Squares;
use super::unfitted::random_rotation;
use coma_frame::{Image, RgbdFrame, normals};
use coma_geometry::{Intrinsics, Pose};
use coma_surfel::Surfel;
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

/// How a pixel becomes a surfel.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SeedSettings {
    /// Every n-th pixel in both directions becomes a surfel; the paper takes every one.
    pub spacing_px: usize,
    /// Standard deviation of a surfel in units of the spacing; the paper takes 1 (eq. 6). At 0.8 neighbours
    /// still cover a surface to an opacity of 0.98 and blur it less.
    pub scale_in_spacings: f32,
    /// Where four pixels of the grid that lie in a square are all new and see one plane, and a picture of half the
    /// grid's resolution, interpolated, shows their colours to within this, 0..1, in every channel, one surfel of
    /// twice the size stands for them. 0: every pixel has its own.
    pub even_color: f32,
    /// Opacity at birth.
    pub opacity: f32,
    /// A surfel on an inclined surface is stretched along the incline so that its picture keeps its size, at
    /// most by this factor. 1 is the paper's eq. 6.
    pub max_stretch: f32,
    /// How a surfel is turned: `surface` or `random`.
    pub fit: Fit,
    /// Of random rotations.
    pub random_seed: u64,
}

/// How a new surfel is turned and scaled.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Fit {
    /// Like the surface that the pixel sees (eq. 6 to 8).
    #[default]
    Surface,
    /// Any way, with the mean of the two scales: what surface-fitting is compared with.
    Random,
}

impl Default for SeedSettings {
    fn default() -> Self {
        SeedSettings {
            spacing_px: 2,
            scale_in_spacings: 0.8,
            even_color: 0.015,
            opacity: 0.95,
            max_stretch: 3.0,
            fit: Fit::Surface,
            random_seed: 1,
        }
    }
}

/// The pixels that may become surfels: every n-th in both directions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SeedGrid {
    /// Pixel `(i, j)` of this camera is the frame's `(first + spacing * i, first + spacing * j)`.
    pub camera: Intrinsics,
    pub(super) spacing: usize,
    first: usize,
}

impl SeedGrid {
    /// Of a frame's camera.
    pub fn of(camera: &Intrinsics, settings: &SeedSettings) -> Self {
        let spacing = settings.spacing_px.max(1);
        let (first, factor) = (spacing / 2, 1.0 / spacing as f64);
        let count = |length: u32| (length as usize).saturating_sub(first).div_ceil(spacing) as u32;
        let camera = Intrinsics {
            width: count(camera.width),
            height: count(camera.height),
            fx: camera.fx * factor,
            fy: camera.fy * factor,
            cx: (camera.cx - first as f64) * factor,
            cy: (camera.cy - first as f64) * factor,
        };
        SeedGrid { camera, spacing, first }
    }

    /// The frame's pixel at `(i, j)` of the grid.
    pub fn pixel(&self, i: usize, j: usize) -> (usize, usize) {
        (self.first + self.spacing * i, self.first + self.spacing * j)
    }

    /// An image's values on the grid.
    pub fn pick<T: Copy>(&self, image: &Image<T>) -> Image<T> {
        Image::from_fn(self.camera.width as usize, self.camera.height as usize, |i, j| {
            image[self.pixel(i, j)]
        })
    }
}

/// Surfels for the pixels of the seed grid at which `wanted` holds, in the submap's frame. Pixels without
/// depth or normal (a depth jump) make none.
pub fn seed(
    frame: &RgbdFrame,
    submap_from_camera: &Pose,
    settings: &SeedSettings,
    grid: &SeedGrid,
    wanted: &Image<bool>,
    color_at: impl Fn(usize, usize) -> [f32; 3] + Sync,
) -> Vec<Surfel> {
    let rotation = submap_from_camera.rotation.to_rotation_matrix().matrix().cast::<f32>();
    let translation: Vector3<f32> = submap_from_camera.translation.vector.cast();
    let surfel = |(x, y): (usize, usize), size: f32, color: [f32; 3]| {
        let (center, axes, fitted) = disc(frame, x, y, size, settings)?;
        let submap_axes = Rotation3::from_matrix_unchecked(rotation * axes);
        let (q, scale) = match settings.fit {
            Fit::Surface => (UnitQuaternion::from_rotation_matrix(&submap_axes), fitted),
            Fit::Random => (
                random_rotation(settings.random_seed, frame.sequence, x, y),
                [0.5 * (fitted[0] + fitted[1]); 2],
            ),
        };
        Some(Surfel {
            center_m: (rotation * center + translation).into(),
            rotation_wxyz: [q.w, q.i, q.j, q.k],
            scale_m: scale,
            opacity: settings.opacity,
            color,
        })
    };
    let squares = (settings.even_color > 0.0).then(|| Squares::of(frame, grid, &color_at));
    let mut out = Vec::new();
    for (j, i) in
        (0..wanted.height()).step_by(2).flat_map(|j| (0..wanted.width()).step_by(2).map(move |i| (j, i)))
    {
        let square = [(i, j), (i + 1, j), (i, j + 1), (i + 1, j + 1)];
        let even = squares.as_ref().filter(|_| square.iter().all(|at| wanted.get(at.0, at.1) == Some(&true)));
        if let Some(one) = even.and_then(|s| s.even(i, j, settings.even_color, &color_at)) {
            let larger = surfel(one.middle, 2.0, one.color);
            if let Some(larger) = larger {
                out.push(larger);
                continue;
            }
        }
        let inside = square.iter().filter(|(i, j)| *i < wanted.width() && *j < wanted.height());
        for (i, j) in inside.filter(|at| wanted[**at]) {
            let (x, y) = grid.pixel(*i, *j);
            out.extend(surfel((x, y), 1.0, color_at(x, y)));
        }
    }
    out
}

/// Centre, axes `(e1, e2, n)` and scales of a disc, in the camera: `size` times that of a pixel of the grid.
fn disc(
    frame: &RgbdFrame,
    x: usize,
    y: usize,
    size: f32,
    settings: &SeedSettings,
) -> Option<(Vector3<f32>, Matrix3<f32>, [f32; 2])> {
    let z = frame.depth_m[(x, y)];
    let n = Vector3::from(normals::normal_at(&frame.depth_m, &frame.camera, 0.05, 2, x, y)?);
    let ray: Vector3<f32> = frame.camera.ray(x as f64, y as f64).cast();
    let view = ray.normalize();
    // eq. (8): R = (e1, e2, n); e1 lies along the incline, so that only it needs stretching.
    let cos = (-n.dot(&view)).clamp(0.0, 1.0);
    let incline = view + n * cos;
    let e1 = if incline.norm() > 1e-3 { incline.normalize() } else { n.cross(&Vector3::y()).normalize() };
    let e2 = n.cross(&e1);
    // eq. (6): s = (D / fx, D / fy), times the seed spacing.
    let spread = size * settings.spacing_px.max(1) as f32 * settings.scale_in_spacings;
    let base = spread * z * (0.5 / frame.camera.fx + 0.5 / frame.camera.fy) as f32;
    let stretch = (1.0 / cos.max(1e-3)).clamp(1.0, settings.max_stretch.max(1.0));
    Some((ray * z, Matrix3::from_columns(&[e1, e2, n]), [base * stretch, base]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_frame::DepthNoise;
    use coma_geometry::StampNs;

    fn wall() -> RgbdFrame {
        let camera = Intrinsics { width: 32, height: 24, fx: 30.0, fy: 30.0, cx: 15.5, cy: 11.5 };
        let color = Image::filled(32, 24, [200u8, 100, 50]);
        let depth = Image::filled(32, 24, 2.0f32);
        RgbdFrame::new(0, StampNs(0), camera, DepthNoise::default(), color, depth).unwrap()
    }

    #[test]
    fn surfels_lie_on_the_surface_and_face_the_camera() {
        let frame = wall();
        let pose = Pose::translation(1.0, 0.0, 0.0);
        let settings = SeedSettings { even_color: 0.0, ..SeedSettings::default() };
        let grid = SeedGrid::of(&frame.camera, &settings);
        let all = Image::filled(16, 12, true);
        let surfels = seed(&frame, &pose, &settings, &grid, &all, |_, _| [1.0, 0.5, 0.2]);
        assert!(surfels.len() > 80);
        for s in &surfels {
            assert!((s.center_m[2] - 2.0).abs() < 1e-5);
            let r = s.rotation();
            assert!((r[(2, 2)] + 1.0).abs() < 1e-4, "normal {:?}", r.column(2));
            assert!((r.determinant() - 1.0).abs() < 1e-4);
        }
    }

    #[test]
    fn surfels_that_are_not_fitted_lie_where_the_others_do_and_face_any_way() {
        let frame = wall();
        let of = |fit| {
            let settings = SeedSettings { fit, ..Default::default() };
            let grid = SeedGrid::of(&frame.camera, &settings);
            let all = Image::filled(16, 12, true);
            seed(&frame, &Pose::identity(), &settings, &grid, &all, |_, _| [0.5; 3])
        };
        let (fitted, random) = (of(Fit::Surface), of(Fit::Random));
        assert_eq!(fitted.len(), random.len());
        let mut away = 0;
        for (f, r) in fitted.iter().zip(&random) {
            assert_eq!(f.center_m, r.center_m);
            assert_eq!(r.scale_m[0], r.scale_m[1]);
            assert!((2.0 * r.scale_m[0] - f.scale_m[0] - f.scale_m[1]).abs() < 1e-6);
            away += (r.rotation()[(2, 2)] > -0.5) as usize;
        }
        // Three of four normals are more than 60 degrees from the wall's.
        assert!(away * 10 > random.len() * 6 && away * 10 < random.len() * 9, "{away} of {}", random.len());
    }

    #[test]
    fn scales_follow_equation_6() {
        let settings =
            SeedSettings { spacing_px: 1, scale_in_spacings: 1.0, max_stretch: 1.0, ..Default::default() };
        let frame = wall();
        let grid = SeedGrid::of(&frame.camera, &settings);
        let one = Image::from_fn(32, 24, |x, y| (x, y) == (15, 11));
        let surfels = seed(&frame, &Pose::identity(), &settings, &grid, &one, |_, _| [0.0; 3]);
        assert_eq!(surfels.len(), 1);
        assert!((surfels[0].scale_m[0] - 2.0 / 30.0).abs() < 1e-6);
    }

    #[test]
    fn the_grid_s_rays_are_those_of_its_pixels() {
        let camera = Intrinsics { width: 33, height: 24, fx: 30.0, fy: 31.0, cx: 15.2, cy: 11.5 };
        for spacing_px in [1, 2, 3] {
            let grid = SeedGrid::of(&camera, &SeedSettings { spacing_px, ..Default::default() });
            let last = (grid.camera.width as usize - 1, grid.camera.height as usize - 1);
            for (i, j) in [(0, 0), (3, 5), last] {
                let (x, y) = grid.pixel(i, j);
                assert!(x < 33 && y < 24);
                assert!(
                    (grid.camera.ray(i as f64, j as f64) - camera.ray(x as f64, y as f64)).norm() < 1e-12
                );
            }
            assert!(grid.pixel(last.0 + 1, 0).0 >= 33 && grid.pixel(0, last.1 + 1).1 >= 24);
        }
    }

    #[test]
    fn what_is_even_is_made_of_larger_surfels_and_what_is_not_of_small_ones() {
        let even = SeedSettings::default();
        let size_px = |s: &Surfel| s.scale_m[1] / s.center_m[2] * 30.0 / 1.6;
        let sizes = |frame: &RgbdFrame| -> Vec<f32> {
            let grid = SeedGrid::of(&frame.camera, &even);
            let wanted = grid.pick(&frame.depth_m).map(|z| *z > 0.0);
            let color = |x, y| frame.color[(x, y)].map(|v| v as f32 / 255.0);
            seed(frame, &Pose::identity(), &even, &grid, &wanted, color).iter().map(size_px).collect()
        };
        let share = |frame: &RgbdFrame| {
            let sizes = sizes(frame);
            sizes.iter().filter(|size| (**size - 2.0).abs() < 1e-3).count() as f32 / sizes.len() as f32
        };
        let plain = wall();
        assert!(share(&plain) > 0.6, "{}", share(&plain));
        // Every other cell is brighter by more than is even.
        let checked = Image::from_fn(32, 24, |x, y| [200 + (((x / 2 + y / 2) % 2) * 8) as u8, 100, 50]);
        let checked =
            RgbdFrame::new(0, StampNs(0), plain.camera, plain.noise, checked, plain.depth_m.clone()).unwrap();
        assert_eq!(share(&checked), 0.0);
        // Half the resolution shows a slope; beside a step it does not.
        let shaded = |shade: fn(usize) -> u8| {
            let color = Image::from_fn(32, 24, |x, _| [shade(x), 100, 50]);
            RgbdFrame::new(0, StampNs(0), plain.camera, plain.noise, color, plain.depth_m.clone()).unwrap()
        };
        let (slope, step) = (shaded(|x| 3 * x as u8), shaded(|x| if x < 16 { 100 } else { 130 }));
        assert_eq!(share(&slope), share(&plain));
        let grid = SeedGrid::of(&slope.camera, &even);
        let wanted = Image::filled(16, 12, true);
        let shade = |x, y| slope.color[(x, y)].map(|v| v as f32 / 255.0);
        for s in seed(&slope, &Pose::identity(), &even, &grid, &wanted, shade) {
            let x = (s.center_m[0] / s.center_m[2] * 30.0 + 15.5).round();
            assert!((s.color[0] - 3.0 * x / 255.0).abs() < 1e-4, "{:?} at {x}", s.color);
        }
        assert!(share(&step) > 0.2 && share(&step) < 0.5, "{}", share(&step));
        // A pipe of 0.2 m.
        let bent = Image::from_fn(32, 24, |x, _| {
            let across = (x as f32 - 15.5) / 30.0 * 2.0;
            2.0 - (0.04 - across * across).max(0.0).sqrt()
        });
        let bent = RgbdFrame::new(
            0,
            StampNs(0),
            plain.camera,
            DepthNoise { base_m: 1e-4, quadratic_per_m: 0.0 },
            plain.color.clone(),
            bent,
        );
        let bent = bent.unwrap();
        let grid = SeedGrid::of(&bent.camera, &even);
        let color = |x, y| bent.color[(x, y)].map(|v| v as f32 / 255.0);
        let on_pipe = Image::from_fn(16, 12, |i, _| (6..10).contains(&i));
        let found = seed(&bent, &Pose::identity(), &even, &grid, &on_pipe, color);
        assert!(!found.is_empty() && found.iter().all(|s| (size_px(s) - 1.0).abs() < 1e-3));
    }
}
