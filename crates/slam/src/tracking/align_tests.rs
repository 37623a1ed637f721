use super::*;
use coma_frame::Image;
use coma_geometry::{Intrinsics, Tangent};

const CAMERA: Intrinsics = Intrinsics { width: 160, height: 120, fx: 140.0, fy: 140.0, cx: 79.5, cy: 59.5 };

/// A room's corner with a box, textured by place: seen exactly from `world_from_camera`.
fn corner(world_from_camera: &Pose, gain: f32, offset: f32) -> TrackingView {
    let origin = world_from_camera.translation.vector;
    let mut depth = Image::filled(160, 120, 0.0f32);
    let mut intensity = Image::filled(160, 120, 0.0f32);
    for y in 0..120 {
        for x in 0..160 {
            let ray = world_from_camera.rotation * CAMERA.ray(x as f64, y as f64);
            // Walls x = 1.0, y = 0.8 (floor), z = 3; a slab x < -0.6 at z = 2.2.
            let mut t = f64::INFINITY;
            for (axis, at) in [(0, 1.0), (1, 0.8), (2, 3.0)] {
                let hit = (at - origin[axis]) / ray[axis];
                if hit > 0.0 {
                    t = t.min(hit);
                }
            }
            let slab = (2.2 - origin.z) / ray.z;
            if slab > 0.0 && slab < t && (origin + ray * slab).x < -0.6 {
                t = slab;
            }
            let p = origin + ray * t;
            depth[(x, y)] = t as f32;
            let texture = 0.5
                + 0.15 * (7.0 * p.x + 3.0 * p.z).sin()
                + 0.15 * (6.0 * p.y - 4.0 * p.x).cos()
                + 0.1 * (9.0 * p.z + 5.0 * p.y).sin();
            intensity[(x, y)] = gain * texture as f32 + offset;
        }
    }
    TrackingView::build(CAMERA, depth, intensity, DepthNoise { base_m: 0.001, quadratic_per_m: 0.0 }, 3)
}

fn motion() -> Pose {
    se3::exp(&Tangent::new(0.03, -0.02, 0.025, 0.02, -0.03, 0.015))
}

#[test]
fn a_known_motion_is_recovered_below_a_millimetre() {
    let found = align(
        &corner(&Pose::identity(), 1.0, 0.0),
        &corner(&motion(), 1.0, 0.0),
        &Pose::identity(),
        Brightness::default(),
        &AlignSettings::default(),
    )
    .unwrap();
    let (metres, radians) = se3::distance(&found.reference_from_camera, &motion());
    assert!(metres < 1e-3 && radians < 5e-4, "{metres} m, {radians} rad");
    assert!(found.inlier_share() > 0.7, "{}", found.inlier_share());
}

#[test]
fn a_change_of_exposure_is_taken_up_by_the_gain() {
    let found = align(
        &corner(&Pose::identity(), 1.0, 0.0),
        &corner(&motion(), 0.8, 0.0),
        &Pose::identity(),
        Brightness::default(),
        &AlignSettings::default(),
    )
    .unwrap();
    let (metres, _) = se3::distance(&found.reference_from_camera, &motion());
    assert!(metres < 1.5e-3, "{metres} m");
    assert!((found.brightness.gain - 1.25).abs() < 0.01, "{:?}", found.brightness);
}

#[test]
fn without_photometric_weight_geometry_alone_recovers_the_corner() {
    // One fine level, from nearby: the coarse ones see too little of floor and wall.
    let nearby = se3::exp(&(se3::log(&motion()) * 0.7));
    let settings =
        AlignSettings { photometric_weight: 0.0, steps: vec![15], max_distance_m: 0.1, ..Default::default() };
    let reference = corner(&Pose::identity(), 1.0, 0.0);
    let found =
        align(&reference, &corner(&motion(), 1.0, 0.0), &nearby, Brightness::default(), &settings).unwrap();
    let (metres, radians) = se3::distance(&found.reference_from_camera, &motion());
    assert!(metres < 1e-3, "{metres} m, {radians} rad");
}

#[test]
fn the_same_bits_come_from_one_thread_and_from_two() {
    let (reference, view) = (corner(&Pose::identity(), 1.0, 0.0), corner(&motion(), 1.0, 0.0));
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            align(&reference, &view, &Pose::identity(), Brightness::default(), &AlignSettings::default())
                .unwrap()
                .reference_from_camera
                .to_homogeneous()
        })
    };
    assert_eq!(run(1), run(2));
}

#[test]
fn a_picture_without_depth_is_no_alignment() {
    let empty = TrackingView::build(
        CAMERA,
        Image::filled(160, 120, 0.0),
        Image::filled(160, 120, 0.5),
        DepthNoise::default(),
        3,
    );
    let reference = corner(&Pose::identity(), 1.0, 0.0);
    let found =
        align(&reference, &empty, &Pose::identity(), Brightness::default(), &AlignSettings::default());
    assert!(found.is_none());
}

#[test]
fn the_gradient_agrees_with_differences_of_the_frozen_association() {
    // A plane and a linear texture, matched exactly: which pixel is associated does not change a residual,
    // and the second-order terms that Gauss-Newton leaves out vanish. Huber's constant is out of reach.
    let plane = || {
        let depth = Image::filled(160, 120, 2.0f32);
        let intensity = Image::from_fn(160, 120, |x, y| 0.2 + 0.003 * x as f32 + 0.001 * y as f32);
        TrackingView::build(CAMERA, depth, intensity, DepthNoise { base_m: 0.01, quadratic_per_m: 0.0 }, 1)
    };
    let (reference, view) = (plane(), plane());
    let settings = AlignSettings { freedom: 1e9, ..Default::default() };
    let problem = Problem {
        reference: &reference.levels[0],
        view: &view.levels[0],
        reference_noise: reference.noise,
        noise: view.noise,
        stride: 1,
        max_distance_m: 1.0,
        settings: &settings,
    };
    let scales = Scales { geometric: 1.0, photometric: 0.05 };
    let brightness = Brightness::default();
    let at = |pose: &Pose, b: Brightness| problem.linearise(pose, b, scales);
    let pose = Pose::identity();
    let system = at(&pose, brightness);
    // The objective's own second-order model predicts the gradient at a moved pose: g(d) = g + H d.
    for axis in [0, 1, 2, 5] {
        let step = 1e-3;
        let mut d = Tangent::zeros();
        d[axis] = step;
        let difference = (at(&(se3::exp(&d) * pose), brightness).gradient - system.gradient) / step;
        let predicted = system.hessian.column(axis).into_owned();
        let error = (difference - predicted).norm() / predicted.norm();
        assert!(error < 0.05, "axis {axis}: {error}");
    }
}

#[test]
fn a_gain_s_bias_adds_up_to_little() {
    // Every frame takes over the gain before and errs by one in ten thousand.
    let after =
        |share: f64| (0..10_000).fold(1.0, |gain, _| Brightness { gain: gain * 0.9999 }.relaxed(share).gain);
    assert!(after(0.0) < 0.4, "{}", after(0.0));
    assert!(after(0.005) > 0.97, "{}", after(0.005));
    assert_eq!(Brightness { gain: 2.0 }.relaxed(0.25).gain, 1.75);
}
