//! Registration of views whose motion is known exactly: a ray-cast room.

use coma_frame::{DepthNoise, Image};
use coma_geometry::nalgebra::{Point3, Vector3};
use coma_geometry::{Intrinsics, Pose, Tangent, se3};
use coma_registration::{Outcome, Prepared, Reason, Refiner, Settings, Side, View, align, refine};

const CAMERA: Intrinsics = Intrinsics { width: 320, height: 240, fx: 260.0, fy: 260.0, cx: 159.5, cy: 119.5 };

/// Boxes by two corners. The first is seen from inside (the room), the others from outside.
const FURNISHED: [([f64; 3], [f64; 3]); 6] = [
    ([-2.0, -1.4, -1.5], [2.2, 1.2, 3.2]),
    ([-1.9, 0.4, 2.2], [-0.9, 1.2, 3.1]),
    ([0.2, 0.1, 2.4], [0.9, 1.2, 3.0]),
    ([1.3, 0.6, 0.8], [2.1, 1.2, 2.0]),
    ([-0.5, -0.9, 2.9], [0.3, -0.2, 3.2]),
    ([-1.9, -0.5, 1.2], [-1.5, 0.1, 1.9]),
];
/// Another room.
const ELSEWHERE: [([f64; 3], [f64; 3]); 4] = [
    ([-1.5, -1.2, -1.0], [1.4, 1.3, 2.6]),
    ([-0.6, 0.7, 1.2], [0.5, 1.3, 1.9]),
    ([0.9, -0.8, 1.8], [1.4, 1.3, 2.5]),
    ([-1.4, -0.2, 0.9], [-1.0, 1.3, 1.5]),
];

/// Distance along `ray` to the scene.
fn cast(scene: &[([f64; 3], [f64; 3])], origin: &Point3<f64>, ray: &Vector3<f64>) -> f64 {
    let mut best = f64::INFINITY;
    for (i, (low, high)) in scene.iter().enumerate() {
        let (mut enter, mut leave) = (f64::NEG_INFINITY, f64::INFINITY);
        for axis in 0..3 {
            let (a, b) = ((low[axis] - origin[axis]) / ray[axis], (high[axis] - origin[axis]) / ray[axis]);
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        let hit = if i == 0 { leave } else { enter };
        if enter < leave && hit > 0.0 {
            best = best.min(hit);
        }
    }
    best
}

fn hash(x: i64, y: i64, z: i64) -> f64 {
    let mut h = (x * 73_856_093) as u64 ^ (y * 19_349_663) as u64 ^ (z * 83_492_791) as u64;
    h = (h ^ (h >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    h = (h ^ (h >> 32)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((h >> 40) & 0xffff) as f64 / 65_535.0
}

/// Trilinear value noise of 15 cm cells.
fn texture(p: &Point3<f64>) -> f32 {
    let q = p.coords / 0.15;
    let base = q.map(f64::floor);
    let f = q - base;
    let mut value = 0.0;
    for corner in 0..8 {
        let (dx, dy, dz) = (corner & 1, corner >> 1 & 1, corner >> 2 & 1);
        let w = |d: i64, f: f64| if d == 1 { f } else { 1.0 - f };
        value += w(dx, f.x)
            * w(dy, f.y)
            * w(dz, f.z)
            * hash(base.x as i64 + dx, base.y as i64 + dy, base.z as i64 + dz);
    }
    value as f32
}

/// What a camera sees. Depth carries the noise of a Kinect, from a fixed sequence.
fn view(scene: &[([f64; 3], [f64; 3])], map_from_camera: &Pose, textured: bool) -> View {
    let noise = DepthNoise::default();
    let mut intensity = Image::filled(320, 240, 0.5f32);
    let depth_m = Image::from_fn(320, 240, |x, y| {
        let ray = map_from_camera.rotation * CAMERA.ray(x as f64, y as f64);
        let origin = Point3::from(map_from_camera.translation.vector);
        let z = cast(scene, &origin, &ray);
        if textured {
            intensity[(x, y)] = texture(&(origin + ray * z));
        }
        // The sum of four uniform numbers has a variance of 1/3.
        let normal: f64 = (0..4).map(|k| hash(x as i64, y as i64, 77 + k) - 0.5).sum::<f64>() * 3f64.sqrt();
        (z + normal * noise.sigma_m(z as f32) as f64) as f32
    });
    View { depth_m, intensity, camera: CAMERA, noise }
}

fn pose(t: [f64; 3], r: [f64; 3]) -> Pose {
    se3::exp(&Tangent::new(t[0], t[1], t[2], r[0], r[1], r[2]))
}

fn two_poses() -> (Pose, Pose) {
    (pose([0.1, 0.0, -1.0], [0.05, -0.2, 0.02]), pose([0.6, -0.2, -0.8], [0.1, -0.45, -0.1]))
}

#[test]
fn a_known_motion_is_recovered_within_its_own_covariance() {
    let (a, b) = two_poses();
    let truth = b.inv_mul(&a);
    let outcome = align(&view(&FURNISHED, &a, true), &view(&FURNISHED, &b, true), &Settings::default(), 1);
    let Outcome::Accepted(found) = outcome else { panic!("{outcome:?}") };
    let (m, rad) = se3::distance(&truth, &found.target_from_source);
    assert!(m < 0.01 && rad.to_degrees() < 0.3, "{m} m, {} degrees", rad.to_degrees());
    let error = se3::log(&truth.inv_mul(&found.target_from_source));
    let squared = (error.transpose() * found.information * error)[0];
    // Six degrees of freedom: the 99.9 % quantile of chi square is 22.5.
    assert!(squared < 22.5, "{squared}");
}

#[test]
fn generalised_icp_finds_the_motion_by_surfaces_alone() {
    let (a, b) = two_poses();
    let truth = b.inv_mul(&a);
    let settings = Settings { refiner: Refiner::Generalised, ..Settings::default() };
    let outcome = align(&view(&FURNISHED, &a, false), &view(&FURNISHED, &b, false), &settings, 1);
    let Outcome::Accepted(found) = outcome else { panic!("{outcome:?}") };
    let (m, rad) = se3::distance(&truth, &found.target_from_source);
    // Without colour the noise of the depth is all that is left.
    assert!(m < 0.02 && rad.to_degrees() < 0.5, "{m} m, {} degrees", rad.to_degrees());
    // Brightness that it does not look at must not make a wall observable.
    let wall = [([-50.0, -50.0, -50.0], [50.0, 50.0, 2.0])];
    let prepared = |p: &Pose| Prepared::new(&view(&wall, p, true), &settings, Side::Source).unwrap();
    let wall = prepared(&Pose::identity());
    let refined = refine(&wall, &prepared(&pose([0.03, 0.02, 0.0], [0.0; 3])), &Pose::identity(), &settings);
    assert!(matches!(refined, Err(Reason::Unobservable { .. })), "{refined:?}");
}

#[test]
fn swapping_the_views_inverts_the_pose() {
    let (a, b) = two_poses();
    let (a, b) = (view(&FURNISHED, &a, true), view(&FURNISHED, &b, true));
    let of = |s, t| align(s, t, &Settings::default(), 1).alignment().expect("accepted").target_from_source;
    let (m, rad) = se3::distance(&of(&a, &b), &of(&b, &a).inverse());
    assert!(m < 1e-3 && rad < 1e-3, "{m} m, {rad} rad");
}

#[test]
fn a_plain_wall_is_unobservable_and_never_accepted() {
    // Only the far side of the room, 2 m away, fills the image.
    let wall = [([-50.0, -50.0, -50.0], [50.0, 50.0, 2.0])];
    let (a, b) = (Pose::identity(), pose([0.1, 0.0, 0.0], [0.0, 0.0, 0.0]));
    let settings = Settings::default();
    let (a, b) = (view(&wall, &a, false), view(&wall, &b, false));
    let prepared = |v| Prepared::new(v, &settings, Side::Source).unwrap();
    let refined = refine(&prepared(&a), &prepared(&b), &Pose::identity(), &settings);
    assert!(matches!(refined, Err(Reason::Unobservable { .. })), "{refined:?}");
    let whole = align(&a, &b, &settings, 1);
    assert!(whole.alignment().is_none(), "{whole:?}");
}

#[test]
fn a_plain_corridor_is_unobservable() {
    // Four walls along z, whose ends are out of sight.
    let corridor = [([-0.9, -1.2, -50.0], [0.9, 1.1, 50.0])];
    let settings = Settings::default();
    let ahead = view(&corridor, &pose([0.0, 0.0, 0.0], [0.05, 0.02, 0.0]), false);
    let further = view(&corridor, &pose([0.05, 0.0, 0.3], [0.05, 0.02, 0.0]), false);
    let prepared = |v| Prepared::new(v, &settings, Side::Source).unwrap();
    let refined = refine(&prepared(&ahead), &prepared(&further), &Pose::identity(), &settings);
    assert!(matches!(refined, Err(Reason::Unobservable { .. })), "{refined:?}");
    assert!(align(&ahead, &further, &settings, 1).alignment().is_none());
}

#[test]
fn texture_pins_a_wall_that_geometry_does_not() {
    let wall = [([-50.0, -50.0, -50.0], [50.0, 50.0, 2.0])];
    let (a, b) = (Pose::identity(), pose([0.03, 0.02, 0.0], [0.0, 0.0, 0.01]));
    let settings = Settings::default();
    let prepared = |p: &Pose| Prepared::new(&view(&wall, p, true), &settings, Side::Source).unwrap();
    let refined = refine(&prepared(&a), &prepared(&b), &Pose::identity(), &settings).unwrap();
    let (m, rad) = se3::distance(&b.inv_mul(&a), &refined.target_from_source);
    assert!(m < 0.005 && rad < 0.003, "{m} m, {rad} rad");
}

#[test]
fn two_rooms_are_told_apart() {
    let (a, b) = two_poses();
    let outcome = align(&view(&FURNISHED, &a, true), &view(&ELSEWHERE, &b, true), &Settings::default(), 1);
    assert!(outcome.alignment().is_none(), "{outcome:?}");
}

#[test]
fn equal_surfaces_with_another_pattern_are_a_photometric_mismatch() {
    let (a, _) = two_poses();
    let source = view(&FURNISHED, &a, true);
    let mut target = source.clone();
    target.intensity = Image::from_fn(320, 240, |x, y| hash(x as i64 / 12, y as i64 / 12, 5) as f32);
    let outcome = align(&source, &target, &Settings::default(), 1);
    assert!(matches!(outcome, Outcome::Rejected(Reason::PhotometricMismatch { .. })), "{outcome:?}");
}

#[test]
fn a_wrong_focal_length_moves_the_motion_as_far_as_was_foretold_and_too_far_is_refused() {
    let (a, b) = two_poses();
    let settings = Settings { focal_uncertainty: 0.01, ..Default::default() };
    let (mut source, mut target) = (view(&FURNISHED, &a, true), view(&FURNISHED, &b, true));
    let refined = |source: &View, target: &View| {
        let prepared = |view: &View| Prepared::new(view, &settings, Side::Source).unwrap();
        refine(&prepared(source), &prepared(target), &b.inv_mul(&a), &settings).unwrap()
    };
    let right = refined(&source, &target);
    for camera in [&mut source.camera, &mut target.camera] {
        (camera.fx, camera.fy) = (camera.fx * 1.01, camera.fy * 1.01);
    }
    let wrong = refined(&source, &target);
    let moved_m =
        (wrong.target_from_source.translation.vector - right.target_from_source.translation.vector).norm();
    assert!(right.calibration_m > 0.001, "{}", right.calibration_m);
    assert!((moved_m - right.calibration_m).abs() < 0.5 * right.calibration_m, "{moved_m} {right:?}");
    let strict = Settings { max_calibration_m: 0.5 * right.calibration_m, ..settings };
    let outcome = align(&source, &target, &strict, 7);
    assert!(matches!(outcome, Outcome::Rejected(Reason::PoorlyConstrained { .. })), "{outcome:?}");
}

#[test]
fn the_same_bits_come_from_any_number_of_threads() {
    let (a, b) = two_poses();
    let (a, b) = (view(&FURNISHED, &a, true), view(&FURNISHED, &b, true));
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| align(&a, &b, &Settings::default(), 9))
    };
    assert_eq!(run(1), run(3));
}

#[test]
fn a_small_intensity_image_and_another_exposure_are_enough() {
    let (a, b) = two_poses();
    let source = view(&FURNISHED, &a, true);
    let mut target = view(&FURNISHED, &b, true);
    target.intensity = coma_frame::pyramid::halve(&target.intensity).map(|v| 0.6 * v + 0.15);
    let outcome = align(&source, &target, &Settings::default(), 1);
    let (m, rad) = se3::distance(&b.inv_mul(&a), &outcome.alignment().expect("accepted").target_from_source);
    assert!(m < 0.01 && rad.to_degrees() < 0.3, "{m} m, {rad} rad");
}

#[test]
fn empty_broken_and_contradictory_views_give_reasons() {
    let good = view(&FURNISHED, &two_poses().0, true);
    let with = |depth: f32| View { depth_m: Image::filled(320, 240, depth), ..good.clone() };
    for broken in [0.0, f32::NAN, f32::INFINITY, -1.0, 100.0] {
        let outcome = align(&good, &with(broken), &Settings::default(), 1);
        let expected = Reason::TooFewPoints { side: Side::Target, found: 0, needed: 200 };
        assert_eq!(outcome, Outcome::Rejected(expected), "depth {broken}");
    }
    let bad_camera = View { camera: Intrinsics { fx: f64::NAN, ..CAMERA }, ..good.clone() };
    let wrong_size = View { depth_m: Image::filled(32, 24, 1.0), ..good.clone() };
    let no_intensity = View { intensity: Image::filled(0, 0, 0.0), ..good.clone() };
    let bad_noise = View { noise: DepthNoise { base_m: f32::NAN, quadratic_per_m: 0.0 }, ..good.clone() };
    for bad in [bad_camera, wrong_size, no_intensity, bad_noise] {
        let outcome = align(&bad, &good, &Settings::default(), 1);
        assert!(
            matches!(outcome, Outcome::Rejected(Reason::InvalidView { side: Side::Source, .. })),
            "{outcome:?}"
        );
    }
    let mut nan_intensity = good.clone();
    nan_intensity.intensity = Image::filled(320, 240, f32::NAN);
    assert!(
        align(&nan_intensity, &good, &Settings::default(), 1)
            .alignment()
            .is_none_or(|a| { a.information.iter().all(|v| v.is_finite()) })
    );
}

#[test]
fn a_reason_is_a_plain_sentence_with_its_numbers() {
    let reason = Reason::TooFewInliers { found: 4, needed: 6 };
    assert_eq!(reason.to_string(), "the best rigid motion explains 4 matches, 6 are needed");
}
