use super::*;
use crate::mapping::seed::{SeedGrid, SeedSettings, seed};
use crate::tracking::model::Part;
use coma_dataset::Sequence;
use coma_dataset::sequence::rgbd_frame;
use coma_dataset::world::{World, WorldSettings};
use coma_raster::{RenderSettings, oracle};
use coma_surfel::SurfelCloud;
use nalgebra::Point3;

/// Frames of the built-in world's first agent.
fn film(width: u32, height: u32) -> impl Sequence {
    let settings = WorldSettings { agents: 1, frames: 8, width, height, ..Default::default() };
    World::new(settings).unwrap().sequence(0).unwrap()
}

/// What a frame shows, in its own camera.
fn surfels(frame: &RgbdFrame, spacing_px: usize) -> SurfelCloud {
    let settings = SeedSettings { spacing_px, ..Default::default() };
    let color = frame.color.to_unit();
    let grid = SeedGrid::of(&frame.camera, &settings);
    let all = Image::filled(grid.camera.width as usize, grid.camera.height as usize, true);
    seed(frame, &Pose::identity(), &settings, &grid, &all, |x, y| color[(x, y)]).into_iter().collect()
}

/// A map of the built-in world is looked at from a known place, and looked for from a guess that is 6 mm and 0.3
/// degrees off: guess, truth, and what was found.
fn refined(settings: &AdamSettings) -> (Pose, Pose, Refined) {
    let frame = rgbd_frame(&film(320, 240), 0).unwrap();
    let cloud = surfels(&frame, 2);
    let render = RenderSettings::default();
    let truth = se3::exp(&Tangent::new(0.02, -0.01, 0.015, 0.01, -0.02, 0.01));
    let views = [SubmapView::new(&cloud, truth.inverse())];
    let seen = coma_raster::render_only(&views, &frame.camera, &render, None, Outputs::Optimising);
    let seen = RgbdFrame { color: seen.color.to_bytes(), depth_m: seen.depth_m, ..frame };
    let model = Model { submaps: vec![Part::new(&cloud, Pose::identity())], render: &render };
    let guess = truth * se3::exp(&Tangent::new(0.004, -0.003, 0.003, 0.003, -0.003, 0.003));
    (guess, truth, refine(&model, &seen, &guess, Brightness::default(), settings).unwrap())
}

#[test]
fn a_known_small_motion_in_the_built_in_world_is_found() {
    let (guess, truth, found) = refined(&AdamSettings::default());
    let before = se3::distance(&guess, &truth);
    let after = se3::distance(&found.agent_from_camera, &truth);
    assert!(after.0 < 0.3 * before.0 && after.1 < 0.15 * before.1, "from {before:?} to {after:?}");
}

#[test]
fn without_steps_the_guess_stays_as_it_is() {
    let (guess, _, found) = refined(&AdamSettings { steps: 0, ..Default::default() });
    assert_eq!(found.agent_from_camera, guess);
    assert!(found.loss > 0.0 && found.loss.is_finite());
}

#[test]
fn a_picture_without_depth_leaves_nothing_to_refine() {
    let film = film(48, 36);
    let frame = rgbd_frame(&film, 0).unwrap();
    let cloud = surfels(&frame, 2);
    let blind = RgbdFrame { depth_m: Image::filled(48, 36, 0.0), ..frame };
    let render = RenderSettings::default();
    let model = Model { submaps: vec![Part::new(&cloud, Pose::identity())], render: &render };
    let found = refine(&model, &blind, &Pose::identity(), Brightness::default(), &AdamSettings::default());
    assert!(found.is_none());
}

/// Eq. 4 in double precision, for pixels that were chosen before.
fn by_definition(
    rendered: &[oracle::OraclePixel],
    observed: Observed<'_>,
    mask: &Image<bool>,
    settings: &AdamSettings,
) -> f64 {
    let counting = || (0..rendered.len()).filter(|i| mask.pixels()[*i]);
    let one = |i: usize| {
        let (color, depth) = (observed.color.pixels()[i], observed.depth_m.pixels()[i]);
        let l1: f64 = (0..3).map(|c| (rendered[i].color[c] - color[c] as f64).abs()).sum();
        l1 / 3.0 + settings.depth_weight as f64 * (rendered[i].depth - depth as f64).abs()
    };
    counting().map(one).sum::<f64>() / counting().count() as f64
}

#[test]
fn the_derivative_by_the_pose_agrees_with_differences_of_the_definition() {
    let film = film(160, 120);
    let (first, other) = (rgbd_frame(&film, 0).unwrap(), rgbd_frame(&film, 4).unwrap());
    // Few, and none as far away as another, so that differences seldom meet a change of depth order.
    let mut cloud = surfels(&first, 8);
    for (i, center) in cloud.center_m.iter_mut().enumerate() {
        center[2] += 0.002 * (12.9898 * i as f32).sin();
    }
    let color = other.color.to_unit();
    let observed = Observed { color: &color, depth_m: &other.depth_m };
    // Little is cut off, so that differences meet no cliff; depth weighs enough to be seen.
    let render = RenderSettings { alpha_min: 1e-7, transmittance_min: 0.0, ..Default::default() };
    let settings = AdamSettings { depth_weight: 0.3, min_opacity: 0.6, ..Default::default() };
    let views = [SubmapView::new(&cloud, Pose::identity())];
    let rendering = coma_raster::render_only(&views, &first.camera, &render, None, Outputs::Optimising);
    let loss = pose_loss(&rendering, observed, &settings);
    assert!(loss.mask.pixels().iter().filter(|counts| **counts).count() > 500);
    let found = coma_raster::backward(&views, &first.camera, &render, &rendering, &loss.by_pixel).pose;

    let base = oracle::in_camera(&views);
    let at = |xi: &Tangent| {
        let moved = se3::exp(&-xi);
        let surfels: Vec<_> = base
            .iter()
            .map(|s| oracle::OracleSurfel {
                center: (moved * Point3::from(s.center)).coords,
                axes: moved.rotation.to_rotation_matrix().matrix() * s.axes,
                ..s.clone()
            })
            .collect();
        by_definition(&oracle::render(&surfels, &first.camera, &render), observed, &loss.mask, &settings)
    };
    assert!((at(&Tangent::zeros()) - loss.value).abs() < 1e-4, "the value itself");
    for axis in 0..6 {
        let step = 1e-6;
        let xi = Tangent::ith(axis, step);
        let difference = (at(&xi) - at(&-xi)) / (2.0 * step);
        let off = (difference - found[axis]).abs();
        assert!(off < 0.02 * found.norm(), "axis {axis}: {} instead of {difference}", found[axis]);
    }
}

#[test]
fn pixels_far_off_or_not_covered_do_not_count() {
    let film = film(160, 120);
    let frame = rgbd_frame(&film, 0).unwrap();
    let cloud = surfels(&frame, 1);
    let color = frame.color.to_unit();
    let render = RenderSettings::default();
    let views = [SubmapView::new(&cloud, Pose::identity())];
    let rendering = coma_raster::render_only(&views, &frame.camera, &render, None, Outputs::Optimising);
    let settings = AdamSettings::default();
    let mut depth_m = frame.depth_m.clone();
    let observed = Observed { color: &color, depth_m: &depth_m };
    let before = pose_loss(&rendering, observed, &settings);
    let counting = before.mask.pixels().iter().position(|counts| *counts).unwrap();
    let middle = (counting % 160, counting / 160);
    depth_m[middle] += 5.0;
    let after = pose_loss(&rendering, Observed { color: &color, depth_m: &depth_m }, &settings);
    assert!(!after.mask[middle] && after.by_pixel.color[middle] == [0.0; 3]);
    for (i, counts) in after.mask.pixels().iter().enumerate() {
        assert!(!counts || rendering.opacity.pixels()[i] > 0.98);
    }
}
