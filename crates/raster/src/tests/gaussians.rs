//! EWA splatting against its definition, and its gradients against differences.

use super::*;
use crate::ewa::oracle::{self, OracleGaussian};
use crate::ewa::{Gaussian, GaussianCloud, GaussianView, Picture, backward, render};

fn gaussians(seed: u64, n: usize) -> GaussianCloud {
    let mut r = Random(seed);
    let one = |_| {
        let z = r.between(1.0, 3.0);
        let axis = Vector3::new(r.between(-2.0, 2.0), r.between(-2.0, 2.0), r.between(-2.0, 2.0));
        let q = UnitQuaternion::from_scaled_axis(axis);
        Gaussian {
            center_m: [r.between(-0.4, 0.4) * z, r.between(-0.3, 0.3) * z, z],
            rotation_wxyz: [q.w, q.i, q.j, q.k],
            scale_m: [r.between(0.05, 0.2), r.between(0.05, 0.2), r.between(0.05, 0.2)],
            opacity: r.between(0.3, 0.9),
            color: [r.next(), r.next(), r.next()],
        }
    };
    (0..n).map(one).collect()
}

fn two_views<'a>(one: &'a GaussianCloud, two: &'a GaussianCloud) -> [GaussianView<'a>; 2] {
    [
        GaussianView { gaussians: one, camera_from_submap: Pose::identity() },
        GaussianView { gaussians: two, camera_from_submap: pose() },
    ]
}

fn worst(picture: &Picture, truth: &[OraclePixel]) -> (f64, usize) {
    let (mut worst, mut off) = (0.0f64, 0);
    for (i, o) in truth.iter().enumerate() {
        let c = picture.color.pixels()[i];
        let by_color = (0..3).map(|k| (c[k] as f64 - o.color[k]).abs()).fold(0.0, f64::max);
        let difference = by_color.max((picture.opacity.pixels()[i] as f64 - o.opacity).abs());
        off += (difference > 1e-4) as usize;
        worst = worst.max(difference);
    }
    (worst, off)
}

#[test]
fn the_definition_agrees_everywhere() {
    let (one, two) = (gaussians(1, 60), gaussians(2, 40));
    let views = two_views(&one, &two);
    for settings in [smooth(), RenderSettings::default()] {
        let picture = render(&views, &CAMERA, &settings, None);
        let truth = oracle::render(&oracle::in_camera(&views), &CAMERA, &settings);
        let (worst, off) = worst(&picture, &truth);
        // A hit at the least alpha may fall to either side; everything else is the same.
        assert!(worst < 5e-3 && off <= 8, "{worst}, {off} pixels off");
        for (i, o) in truth.iter().enumerate().filter(|(_, o)| o.opacity > 0.05) {
            assert!((picture.depth_m.pixels()[i] as f64 - o.depth).abs() < 0.02);
        }
        assert!(picture.hits > 10_000);
    }
}

#[test]
fn the_comparison_sees_a_gaussian_that_is_moved_or_thicker() {
    for change in [0, 1] {
        let mut one = gaussians(1, 60);
        let two = gaussians(2, 40);
        let truth = oracle::render(&oracle::in_camera(&two_views(&one, &two)), &CAMERA, &smooth());
        match change {
            0 => one.center_m[7][0] += 0.02,
            _ => one.scale_m[7][2] *= 1.3,
        }
        let (worst, off) = worst(&render(&two_views(&one, &two), &CAMERA, &smooth(), None), &truth);
        assert!(worst > 2e-3 && off > 8, "{change}: {worst}, {off} pixels off");
    }
}

/// Central differences of the definition's loss under a change of the Gaussians in the camera's frame.
fn difference(base: &[OracleGaussian], step: f64, change: impl Fn(&mut [OracleGaussian], f64)) -> f64 {
    let at = |h: f64| {
        let mut moved = base.to_vec();
        change(&mut moved, h);
        loss(&oracle::render(&moved, &CAMERA, &smooth()))
    };
    (at(step) - at(-step)) / (2.0 * step)
}

#[test]
fn gradients_of_every_parameter_of_a_gaussian_agree_with_differences() {
    let (one, two) = (gaussians(11, 14), gaussians(12, 10));
    let views = two_views(&one, &two);
    let picture = render(&views, &CAMERA, &smooth(), None);
    let found = backward(&views, &CAMERA, &smooth(), &picture, &pixel_gradients());
    let base = oracle::in_camera(&views);
    let step = 1e-5;
    for at in [0, 3, 9, 14, 19, 23] {
        let name = |what: &str| format!("{what} of {at}");
        let camera_from_submap = views[usize::from(at >= one.len())].camera_from_submap;
        for axis in 0..3 {
            let along = camera_from_submap.rotation * Vector3::ith(axis, 1.0);
            let d = difference(&base, step, |g, h| g[at].center += along * h);
            assert_close(&name("centre"), found.center_m[at][axis] as f64, d, 30.0);
            let d = difference(&base, step, |g, h| {
                let turn = UnitQuaternion::from_scaled_axis(Vector3::ith(axis, h));
                g[at].axes *= turn.to_rotation_matrix();
            });
            assert_close(&name("rotation"), found.rotation[at][axis] as f64, d, 5.0);
            let d = difference(&base, step, |g, h| g[at].scale[axis] += h);
            assert_close(&name("scale"), found.scale_m[at][axis] as f64, d, 30.0);
            let d = difference(&base, step, |g, h| g[at].color[axis] += h);
            assert_close(&name("colour"), found.color[at][axis] as f64, d, 2.0);
        }
        let d = difference(&base, step, |g, h| g[at].opacity += h);
        assert_close(&name("opacity"), found.opacity[at] as f64, d, 5.0);
    }
}

#[test]
fn the_gradient_of_the_pose_agrees_with_differences_for_gaussians_too() {
    let (one, two) = (gaussians(11, 14), gaussians(12, 10));
    let views = two_views(&one, &two);
    let picture = render(&views, &CAMERA, &smooth(), None);
    let found = backward(&views, &CAMERA, &smooth(), &picture, &pixel_gradients());
    let base = oracle::in_camera(&views);
    for axis in 0..6 {
        let d = difference(&base, 1e-6, |gaussians, h| {
            let moved = se3::exp(&-(Tangent::ith(axis, h)));
            for g in gaussians {
                g.center = (moved * nalgebra::Point3::from(g.center)).coords;
                g.axes = moved.rotation.to_rotation_matrix().matrix() * g.axes;
            }
        });
        assert_close("pose", found.pose[axis], d, 30.0);
    }
}

#[test]
fn a_flat_gaussian_is_a_disc() {
    // Facing the camera and far larger than a pixel, both models blend the same.
    let q = [1.0, 0.0, 0.0, 0.0];
    let (center_m, opacity, color) = ([0.05, -0.02, 2.0], 0.8, [0.9, 0.4, 0.1]);
    let disc: SurfelCloud =
        [Surfel { center_m, rotation_wxyz: q, scale_m: [0.4; 2], opacity, color }].into_iter().collect();
    let flat: GaussianCloud =
        [Gaussian { center_m, rotation_wxyz: q, scale_m: [0.4, 0.4, 1e-4], opacity, color }]
            .into_iter()
            .collect();
    let settings = RenderSettings::default();
    let camera_from_submap = Pose::identity();
    let of_disc = crate::render(&[SubmapView::new(&disc, camera_from_submap)], &CAMERA, &settings, None);
    let of_flat = render(&[GaussianView { gaussians: &flat, camera_from_submap }], &CAMERA, &settings, None);
    for (d, f) in of_disc.opacity.pixels().iter().zip(of_flat.opacity.pixels()) {
        assert!((d - f).abs() < 0.01, "{d} {f}");
    }
}

#[test]
fn gaussians_that_are_no_numbers_or_behind_the_camera_are_left_out() {
    let good = gaussians(3, 8);
    let mut bad = good.clone();
    for (i, change) in [0, 1, 2, 3, 4].into_iter().enumerate() {
        let mut g = good.get(i);
        match change {
            0 => g.center_m[1] = f32::NAN,
            1 => g.center_m[2] = -1.0,
            2 => g.scale_m[2] = 0.0,
            3 => g.opacity = f32::INFINITY,
            _ => g.rotation_wxyz = [0.0; 4],
        }
        bad.push(g);
    }
    let views = [GaussianView { gaussians: &good, camera_from_submap: Pose::identity() }];
    let with_bad = [GaussianView { gaussians: &bad, camera_from_submap: Pose::identity() }];
    let settings = RenderSettings::default();
    let expected = render(&views, &CAMERA, &settings, None);
    let found = render(&with_bad, &CAMERA, &settings, None);
    assert_eq!(found.color, expected.color);
    let gradients = backward(&with_bad, &CAMERA, &settings, &found, &pixel_gradients());
    assert!(gradients.center_m.iter().flatten().all(|v| v.is_finite()));
    assert!(gradients.center_m[8..].iter().all(|g| *g == [0.0; 3]));
}

#[test]
fn growth_sees_a_gaussian_only_near_the_observed_depth() {
    let wall = Gaussian {
        center_m: [0.0, 0.0, 2.0],
        rotation_wxyz: [1.0, 0.0, 0.0, 0.0],
        scale_m: [0.5, 0.5, 0.01],
        opacity: 0.9,
        color: [0.5; 3],
    };
    let cloud: GaussianCloud = [wall].into_iter().collect();
    let views = [GaussianView { gaussians: &cloud, camera_from_submap: Pose::identity() }];
    let near = |observed: f32| {
        let depth = Image::filled(44, 36, observed);
        let noise = DepthNoise { base_m: 0.001, quadratic_per_m: 0.002 };
        let test = GrowthTest { observed_depth_m: &depth, noise, sigma_factor: 3.0, relative: 0.01 };
        render(&views, &CAMERA, &RenderSettings::default(), Some(&test)).near_surface.unwrap()[(21, 17)]
    };
    assert!(near(2.0) && near(2.02) && near(1.98));
    assert!(!near(2.04) && !near(1.9) && !near(0.0));
}
