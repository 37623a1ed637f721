use super::*;
use crate::mapping::seed::{SeedGrid, SeedSettings};
use coma_frame::DepthNoise;
use coma_geometry::{Intrinsics, StampNs, se3};
use nalgebra::Vector3;

/// A textured wall two metres away.
fn frame(map_from_camera: &Pose) -> RgbdFrame {
    let camera = Intrinsics { width: 48, height: 36, fx: 45.0, fy: 45.0, cx: 23.5, cy: 17.5 };
    let at = |x: usize, y: usize| {
        let ray = map_from_camera.rotation * camera.ray(x as f64, y as f64);
        let origin = map_from_camera.translation.vector;
        let depth = (2.0 - origin.z) / ray.z;
        (depth, origin + ray * depth)
    };
    let color = Image::from_fn(48, 36, |x, y| {
        let p = at(x, y).1;
        let wave = |f: f64| ((0.5 + 0.3 * (f * p.x).sin() * (0.8 * f * p.y).cos()) * 255.0) as u8;
        [wave(4.0), wave(8.0), wave(12.0)]
    });
    let depth_m = Image::from_fn(48, 36, |x, y| at(x, y).0 as f32);
    RgbdFrame::new(0, StampNs(0), camera, DepthNoise::default(), color, depth_m).unwrap()
}

fn poses() -> Vec<Pose> {
    (0..5)
        .map(|i| {
            let t = 0.06 * f64::from(i) - 0.12;
            se3::exp(&coma_geometry::Tangent::new(t, -0.5 * t, 0.3 * t, 0.0, 0.1 * t, 0.0))
        })
        .collect()
}

/// What a run leaves: surfels two pixels apart, of colours that are a little off.
fn coarse_map() -> SurfelCloud {
    let settings = SeedSettings { spacing_px: 2, ..SeedSettings::default() };
    let mut out = SurfelCloud::default();
    let first = frame(&poses()[2]);
    let color = first.color.to_unit();
    let grid = SeedGrid::of(&first.camera, &settings);
    let wanted = Image::filled(grid.camera.width as usize, grid.camera.height as usize, true);
    let dimmed = |x, y| color[(x, y)].map(|v: f32| 0.9 * v);
    for surfel in seed(&first, &poses()[2], &settings, &grid, &wanted, dimmed) {
        out.push(surfel);
    }
    out
}

fn settings(steps: u32) -> RefineSettings {
    RefineSettings { steps, grow_every: 15, poses: true, poses_from_step: 10, ..RefineSettings::default() }
}

fn take(job: &mut Refiner, steps: u32) -> Vec<Step> {
    let frames: Vec<RgbdFrame> = poses().iter().map(frame).collect();
    (0..steps).map_while(|_| job.wants().map(|view| job.step(&frames[view]))).collect()
}

fn job(steps: u32) -> Refiner {
    Refiner::new(settings(steps), coarse_map(), SurfelCloud::default(), poses())
}

#[test]
fn refined_pictures_are_better_and_surfels_stay_on_the_wall() {
    let mut job = job(120);
    let before = job.surfels().len();
    let steps = take(&mut job, 120);
    assert_eq!((steps.len(), job.wants()), (120, None));
    let mean = |steps: &[Step]| steps.iter().map(|s| s.psnr_db).sum::<f64>() / steps.len() as f64;
    let (first, last) = (mean(&steps[..5]), mean(&steps[115..]));
    assert!(last > first + 5.0, "{first:.2} dB became {last:.2} dB");
    assert!(job.surfels().len() > before, "texture finer than the surfels splits them");
    // Surfels of the front view's rim are seen by few; the middle ones tell.
    let off: Vec<f32> = job
        .surfels()
        .iter()
        .filter(|s| Vector3::from(s.center_m).xy().norm() < 0.5)
        .map(|s| (s.center_m[2] - 2.0).abs())
        .collect();
    let off = off.iter().sum::<f32>() / off.len() as f32;
    assert!(off < 0.003, "{off} m off the wall");
}

#[test]
fn a_job_taken_up_again_gives_the_same_bits_as_one_that_was_never_cut_off() {
    let mut whole = job(60);
    take(&mut whole, 60);
    // Cut off within a round, between two times of growing.
    let mut first = job(60);
    take(&mut first, 37);
    let bytes = first.checkpoint();
    let mut second = job(60);
    second.resume(&bytes).unwrap();
    assert_eq!(second.checkpoint(), bytes);
    take(&mut second, 60);
    assert_eq!(second.checkpoint(), whole.checkpoint());
    assert_ne!(whole.surfels(), first.surfels(), "the second part changed something");
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut job = job(40);
            take(&mut job, 40);
            job.checkpoint()
        })
    };
    assert_eq!(on(1), on(2));
}

#[test]
fn fixed_surfels_are_rendered_and_stay_as_they_are() {
    let map = coarse_map();
    let left = |s: &coma_surfel::Surfel| s.center_m[0] < 0.0;
    let (fixed, own): (Vec<_>, Vec<_>) = map.iter().partition(left);
    let fixed: SurfelCloud = fixed.into_iter().collect();
    let with = || Refiner::new(settings(30), own.iter().copied().collect(), fixed.clone(), poses());
    let mut job = with();
    let steps = take(&mut job, 30);
    assert_eq!(job.fixed, fixed);
    let mut alone =
        Refiner::new(settings(30), own.iter().copied().collect(), SurfelCloud::default(), poses());
    let without = take(&mut alone, 1);
    assert!(steps[0].psnr_db > without[0].psnr_db + 3.0, "{steps:?}\n{without:?}");
    // What the fixed ones show grows no surfels of its own.
    let grown = job.surfels().iter().filter(|s| s.center_m[0] < -0.2 && s.center_m[0] > -0.6).count();
    assert!(grown < fixed.len() / 10, "{grown} surfels over fixed ones");
}

#[test]
fn a_checkpoint_that_is_torn_or_of_another_job_is_refused() {
    let mut one = job(20);
    take(&mut one, 10);
    let bytes = one.checkpoint();
    let mut again = job(20);
    for length in [0, 5, 16, 60, bytes.len() / 2, bytes.len() - 1] {
        assert_eq!(again.resume(&bytes[..length]), Err(CheckpointError::Torn), "{length} bytes");
    }
    for at in [20, 60, bytes.len() / 2, bytes.len() - 1] {
        let mut changed = bytes.clone();
        changed[at] ^= 1;
        assert_eq!(again.resume(&changed), Err(CheckpointError::Torn), "byte {at}");
    }
    assert_eq!(again.resume(b"something else altogether, no checkpoint"), Err(CheckpointError::Mark));
    assert_eq!(job(21).resume(&bytes), Err(CheckpointError::OtherJob));
    assert_eq!(again.steps(), 0, "a refused checkpoint changes nothing");
    assert_eq!(again.resume(&bytes), Ok(()));
}

#[test]
fn pictures_of_another_exposure_do_not_change_colours() {
    // Of what a view shows: how many surfels share a place doesn't matter.
    let brightness = |job: &Refiner| {
        let rendering = job.rendering(2, &frame(&poses()[2]));
        let covered = |(color, opacity): (&[f32; 3], &f32)| (*opacity > 0.9).then_some(color[0] / opacity);
        let shown = rendering.color.pixels().iter().zip(rendering.opacity.pixels());
        let colors: Vec<f32> = shown.filter_map(covered).collect();
        colors.iter().sum::<f32>() / colors.len() as f32
    };
    let refine = |exposure| {
        // The prior draws the map towards the pictures' mean by its size in every step: here by 6 % of the way in all.
        let settings = RefineSettings { exposure, exposure_prior: 0.001, poses: false, ..settings(60) };
        let mut job = Refiner::new(settings, coarse_map(), SurfelCloud::default(), poses());
        let before = brightness(&job);
        for _ in 0..60 {
            let Some(view) = job.wants() else { break };
            let mut frame = frame(&poses()[view]);
            // Two of five pictures are a third brighter than the others.
            let gain = if view % 2 == 1 { 1.2 } else { 0.9 };
            frame.color = frame.color.map(|c| c.map(|v| (f32::from(v) * gain).min(255.0) as u8));
            job.step(&frame);
        }
        (brightness(&job) / before - 1.0).abs()
    };
    let (with, without) = (refine(true), refine(false));
    assert!(with < 0.5 * without, "brightness changed by {with} and {without}");
}

#[test]
fn every_round_sees_every_view_once_in_an_order_of_its_own() {
    let mut first = shuffled(50, 1, 0);
    assert_ne!(first, shuffled(50, 1, 1));
    assert_ne!(first, shuffled(50, 2, 0));
    assert_eq!(first, shuffled(50, 1, 0));
    first.sort_unstable();
    assert_eq!(first, (0..50).collect::<Vec<_>>());
}
