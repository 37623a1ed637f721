use super::*;
use coma_frame::DepthNoise;
use coma_geometry::{Intrinsics, Tangent, se3};
use coma_surfel::Surfel;
use nalgebra::{UnitQuaternion, Vector3};
use oracle::OraclePixel;

mod alike;
mod gaussians;
mod poison;

const CAMERA: Intrinsics = Intrinsics { width: 44, height: 36, fx: 40.0, fy: 42.0, cx: 21.5, cy: 17.0 };

/// Numbers in 0..1 from a seed (a linear congruential generator).
struct Random(u64);

impl Random {
    fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (self.0 >> 40) as f32 / (1u64 << 24) as f32
    }

    fn between(&mut self, a: f32, b: f32) -> f32 {
        a + (b - a) * self.next()
    }
}

fn surfels(seed: u64, n: usize) -> SurfelCloud {
    let mut r = Random(seed);
    (0..n)
        .map(|_| {
            let z = r.between(1.0, 3.0);
            let axis = Vector3::new(r.between(-0.7, 0.7), r.between(-0.7, 0.7), r.between(-3.0, 3.0));
            let q = UnitQuaternion::from_scaled_axis(axis);
            Surfel {
                center_m: [r.between(-0.4, 0.4) * z, r.between(-0.3, 0.3) * z, z],
                rotation_wxyz: [q.w, q.i, q.j, q.k],
                scale_m: [r.between(0.06, 0.2), r.between(0.06, 0.2)],
                opacity: r.between(0.3, 0.9),
                color: [r.next(), r.next(), r.next()],
            }
        })
        .collect()
}

fn pose() -> Pose {
    se3::exp(&Tangent::new(0.05, -0.03, 0.1, 0.05, -0.04, 0.1))
}

/// Little is cut off, so that differences do not meet the cliff at `alpha_min`.
fn smooth() -> RenderSettings {
    RenderSettings { alpha_min: 1e-7, transmittance_min: 0.0, ..Default::default() }
}

fn worst_difference(rendering: &Rendering, oracle: &[OraclePixel]) -> (f64, usize) {
    let mut worst = 0.0f64;
    let mut off = 0;
    for (i, o) in oracle.iter().enumerate() {
        let c = rendering.color.pixels()[i];
        let difference = (0..3)
            .map(|k| (c[k] as f64 - o.color[k]).abs())
            .fold((rendering.opacity.pixels()[i] as f64 - o.opacity).abs(), f64::max);
        off += (difference > 1e-4) as usize;
        worst = worst.max(difference);
    }
    (worst, off)
}

#[test]
fn the_oracle_agrees_everywhere() {
    let (one, two) = (surfels(1, 60), surfels(2, 40));
    let views = [SubmapView::new(&one, Pose::identity()), SubmapView::new(&two, pose())];
    for settings in [smooth(), RenderSettings::default()] {
        let rendering = render(&views, &CAMERA, &settings, None);
        let oracle = oracle::render(&oracle::in_camera(&views), &CAMERA, &settings);
        let (worst, off) = worst_difference(&rendering, &oracle);
        // A hit at the least alpha may fall to either side; everything else is the same.
        assert!(worst < 5e-3 && off <= 8, "{worst}, {off} pixels off");
        for (i, o) in oracle.iter().enumerate().filter(|(_, o)| o.opacity > 0.05) {
            let found = rendering.depth_m.pixels()[i] as f64;
            assert!((found - o.depth).abs() < 0.02, "depth {found} {}", o.depth);
        }
        let other = |(i, o): &(usize, &OraclePixel)| {
            let found = rendering.surface_depth_m.pixels()[*i] as f64;
            let shade = rendering.surface_intensity.pixels()[*i] as f64;
            (found - o.surface).abs() > 1e-3 || (shade - o.surface_intensity).abs() > 1e-3
        };
        // A hit may fall to either of two surfaces.
        let others = oracle.iter().enumerate().filter(other).count();
        assert!(others <= 8, "another surface at {others} pixels");
    }
}

#[test]
fn the_front_of_a_ball_lies_where_the_ball_is() {
    // A ball of 0.25 m, 2 m away, made of a disc for every fourth pixel.
    let camera = Intrinsics { width: 96, height: 80, fx: 300.0, fy: 300.0, cx: 47.5, cy: 39.5 };
    let (middle, radius) = (Vector3::new(0.0, 0.0, 2.0), 0.25);
    let front = |x: f64, y: f64| {
        let ray = camera.ray(x, y);
        let (half, squared) = (ray.dot(&middle) / ray.norm_squared(), ray.norm_squared());
        half - (half * half - (middle.norm_squared() - radius * radius) / squared).sqrt()
    };
    let mut ball = SurfelCloud::default();
    for (x, y) in (2..80).step_by(4).flat_map(|y| (2..96).step_by(4).map(move |x| (x as f64, y as f64))) {
        let center = camera.ray(x, y) * front(x, y);
        let turn = UnitQuaternion::rotation_between(&Vector3::z(), &(center - middle)).unwrap().cast::<f32>();
        ball.push(Surfel {
            center_m: center.cast().into(),
            rotation_wxyz: [turn.w, turn.i, turn.j, turn.k],
            scale_m: [(3.2 * center.z / camera.fx) as f32; 2],
            opacity: 0.95,
            color: [0.5; 3],
        });
    }
    let views = [SubmapView::new(&ball, Pose::identity())];
    let rendering = render(&views, &camera, &RenderSettings::default(), None);
    // Half of the ball's width, so that the rim is left out.
    let seen = (22..58).flat_map(|y| (30..66).map(move |x| (x, y)));
    let mean = |image: &Image<f32>| {
        let errors = seen.clone().map(|(x, y)| image[(x, y)] as f64 - front(x as f64, y as f64));
        errors.sum::<f64>() / seen.clone().count() as f64
    };
    let (surface, expected) = (mean(&rendering.surface_depth_m), mean(&rendering.depth_m));
    assert!(surface.abs() < 4e-4 && expected < -1.5e-3, "{surface} m, blended {expected} m");
}

#[test]
fn the_harness_sees_a_surfel_that_is_missing_or_moved() {
    let mut cloud = surfels(1, 60);
    let views = [SubmapView::new(&cloud, Pose::identity())];
    let oracle = oracle::render(&oracle::in_camera(&views), &CAMERA, &smooth());
    cloud.center_m[7][0] += 0.01;
    let views = [SubmapView::new(&cloud, Pose::identity())];
    let rendering = render(&views, &CAMERA, &smooth(), None);
    let (worst, off) = worst_difference(&rendering, &oracle);
    assert!(worst > 5e-3 && off > 8, "{worst}, {off} pixels off");
}

/// A loss with its own weight for every pixel and output, so that no error cancels.
fn weights(i: usize) -> ([f64; 3], f64, f64) {
    let f = |k: f64| (i as f64 * k).sin();
    ([f(0.7), f(1.3), f(2.1)], f(0.37), 0.5 * f(0.91))
}

fn loss(pixels: &[OraclePixel]) -> f64 {
    let term = |(i, p): (usize, &OraclePixel)| {
        let (c, d, a) = weights(i);
        // Expected depth has a cliff where nothing is hit: its weight fades out there.
        let sure = if DEPTH_COUNTS[i] { d } else { 0.0 };
        c[0] * p.color[0] + c[1] * p.color[1] + c[2] * p.color[2] + sure * p.depth + a * p.opacity
    };
    pixels.iter().enumerate().map(term).sum()
}

/// Pixels whose depth is in the loss: those in the middle, that many surfels cover.
static DEPTH_COUNTS: std::sync::LazyLock<Vec<bool>> = std::sync::LazyLock::new(|| {
    let middle = |i: usize| {
        let (x, y) = (i % 44, i / 44);
        (12..32).contains(&x) && (10..26).contains(&y)
    };
    (0..44 * 36).map(middle).collect()
});

fn pixel_gradients() -> PixelGradients {
    let at = |x: usize, y: usize| y * 44 + x;
    PixelGradients {
        color: Image::from_fn(44, 36, |x, y| weights(at(x, y)).0.map(|v| v as f32)),
        depth_m: Image::from_fn(44, 36, |x, y| {
            if DEPTH_COUNTS[at(x, y)] { weights(at(x, y)).1 as f32 } else { 0.0 }
        }),
        opacity: Image::from_fn(44, 36, |x, y| weights(at(x, y)).2 as f32),
    }
}

/// Central differences of the oracle's loss under a change of the surfels in the camera's frame.
fn difference(
    base: &[oracle::OracleSurfel],
    step: f64,
    change: impl Fn(&mut Vec<oracle::OracleSurfel>, f64),
) -> f64 {
    let at = |s: f64| {
        let mut moved = base.to_vec();
        change(&mut moved, s);
        loss(&oracle::render(&moved, &CAMERA, &smooth()))
    };
    (at(step) - at(-step)) / (2.0 * step)
}

fn assert_close(name: &str, found: f64, difference: f64, scale: f64) {
    let error = (found - difference).abs();
    assert!(error < 0.02 * difference.abs() + 0.004 * scale, "{name}: {found} against {difference}");
}

/// Few, so that differences seldom meet the change of depth order.
fn small_scene() -> (SurfelCloud, SurfelCloud) {
    (surfels(11, 14), surfels(12, 10))
}

#[test]
fn gradients_of_every_surfel_parameter_agree_with_differences() {
    let (one, two) = small_scene();
    let views = [SubmapView::new(&one, Pose::identity()), SubmapView::new(&two, pose())];
    let rendering = render(&views, &CAMERA, &smooth(), None);
    let gradients = backward(&views, &CAMERA, &smooth(), &rendering, &pixel_gradients());
    let base = oracle::in_camera(&views);
    let step = 1e-5;
    for (k, (submap, index)) in [(0, 0), (0, 3), (0, 9), (1, 0), (1, 5), (1, 9)].into_iter().enumerate() {
        let g = &gradients.submaps[submap];
        let at = if submap == 0 { index } else { one.len() + index };
        let name = |what: &str| format!("{what} of surfel {k}");
        let camera_from_submap = views[submap].camera_from_submap;
        for axis in 0..3 {
            let along = camera_from_submap.rotation * Vector3::ith(axis, 1.0);
            let d = difference(&base, step, |s, h| s[at].center += along * h);
            assert_close(&name("centre"), g.center_m[index][axis] as f64, d, 30.0);
            let d = difference(&base, step, |s, h| {
                let turn = UnitQuaternion::from_scaled_axis(Vector3::ith(axis, h));
                s[at].axes *= turn.to_rotation_matrix();
            });
            assert_close(&name("rotation"), g.rotation[index][axis] as f64, d, 5.0);
            let d = difference(&base, step, |s, h| s[at].color[axis] += h);
            assert_close(&name("colour"), g.color[index][axis] as f64, d, 2.0);
        }
        for axis in 0..2 {
            let d = difference(&base, step, |s, h| s[at].scale[axis] += h);
            assert_close(&name("scale"), g.scale_m[index][axis] as f64, d, 30.0);
        }
        let d = difference(&base, step, |s, h| s[at].opacity += h);
        assert_close(&name("opacity"), g.opacity[index] as f64, d, 5.0);
    }
}

#[test]
fn the_gradient_of_the_camera_s_pose_agrees_with_differences() {
    let (one, two) = small_scene();
    let views = [SubmapView::new(&one, Pose::identity()), SubmapView::new(&two, pose())];
    let rendering = render(&views, &CAMERA, &smooth(), None);
    let gradients = backward(&views, &CAMERA, &smooth(), &rendering, &pixel_gradients());
    let base = oracle::in_camera(&views);
    for axis in 0..6 {
        let d = difference(&base, 1e-6, |surfels, h| {
            let mut xi = Tangent::zeros();
            xi[axis] = h;
            let moved = se3::exp(&-xi);
            for s in surfels {
                s.center = (moved * nalgebra::Point3::from(s.center)).coords;
                s.axes = moved.rotation.to_rotation_matrix().matrix() * s.axes;
            }
        });
        assert_close("pose", gradients.pose[axis], d, 30.0);
    }
}

#[test]
fn growth_sees_a_surfel_only_near_the_observed_depth() {
    let q = [1.0, 0.0, 0.0, 0.0];
    let wall = Surfel {
        center_m: [0.0, 0.0, 2.0],
        rotation_wxyz: q,
        scale_m: [0.5; 2],
        opacity: 0.9,
        color: [0.5; 3],
    };
    let cloud: SurfelCloud = [wall].into_iter().collect();
    let views = [SubmapView::new(&cloud, Pose::identity())];
    let near = |observed: f32| {
        let depth = Image::filled(44, 36, observed);
        let noise = DepthNoise { base_m: 0.001, quadratic_per_m: 0.002 };
        let test = GrowthTest { observed_depth_m: &depth, noise, sigma_factor: 3.0, relative: 0.01 };
        render(&views, &CAMERA, &RenderSettings::default(), Some(&test)).near_surface.unwrap()[(21, 17)]
    };
    // 3 sigma(2 m) = 2.7 cm, 1 % of 2 m = 2 cm.
    assert!(near(2.0) && near(2.02) && near(1.98));
    assert!(!near(2.04) && !near(1.9) && !near(0.0));
}

#[test]
fn depth_along_a_tilted_surfel_is_that_of_the_ray_s_hit() {
    let tilt = UnitQuaternion::from_scaled_axis(Vector3::new(0.0, 0.6, 0.0));
    let q = [tilt.w, tilt.i, tilt.j, tilt.k];
    let disc = Surfel {
        center_m: [0.0, 0.0, 2.0],
        rotation_wxyz: q,
        scale_m: [0.6; 2],
        opacity: 0.99,
        color: [1.0; 3],
    };
    let cloud: SurfelCloud = [disc].into_iter().collect();
    let views = [SubmapView::new(&cloud, Pose::identity())];
    let rendering = render(&views, &CAMERA, &RenderSettings::default(), None);
    let normal = tilt * Vector3::z();
    let ray = CAMERA.ray(28.0, 17.0).cast::<f32>();
    let truth = normal.z * 2.0 / normal.dot(&ray);
    assert!((rendering.depth_m[(28, 17)] - truth).abs() < 1e-4);
    assert!((rendering.median_depth_m[(28, 17)] - truth).abs() < 1e-4);
    assert!((rendering.surface_depth_m[(28, 17)] - truth).abs() < 1e-4);
    assert!(rendering.normal[(28, 17)][2] < 0.0, "it faces the camera");
}

#[test]
fn the_comparison_of_gradients_sees_5_percent() {
    let wrong = std::panic::catch_unwind(|| assert_close("scale", 105.0, 100.0, 30.0));
    assert!(wrong.is_err());
    assert_close("scale", 100.5, 100.0, 30.0);
}

#[test]
fn a_hidden_surfel_near_the_observed_depth_is_known() {
    let q = [1.0, 0.0, 0.0, 0.0];
    let wall = |z: f32| Surfel {
        center_m: [0.0, 0.0, z],
        rotation_wxyz: q,
        scale_m: [0.5; 2],
        opacity: 0.99,
        color: [0.5; 3],
    };
    let cloud: SurfelCloud = [1.0, 1.1, 1.2, 1.3, 2.0].map(wall).into_iter().collect();
    let views = [SubmapView::new(&cloud, Pose::identity())];
    let depth = Image::filled(44, 36, 2.0f32);
    let noise = DepthNoise { base_m: 0.001, quadratic_per_m: 0.002 };
    let test = GrowthTest { observed_depth_m: &depth, noise, sigma_factor: 3.0, relative: 0.01 };
    let rendering = render(&views, &CAMERA, &RenderSettings::default(), Some(&test));
    assert!(rendering.depth_m[(21, 17)] < 1.1, "nothing of the last one is seen");
    assert!(rendering.near_surface.unwrap()[(21, 17)]);
}
