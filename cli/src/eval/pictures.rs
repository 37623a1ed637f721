//! The merged map, rendered from where the cameras were, against what they saw.

use super::{Options, Read};
use crate::progress;
use crate::refine::folder::{self, Refined};
use crate::run::facts::Facts;
use anyhow::Context;
use coma_evaluation::{FrameScore, Picture, PictureScores, Pictures, View, score_frame};
use coma_frame::{Image, RgbdFrame};
use coma_geometry::{Pose, se3};
use coma_raster::{RenderSettings, Rendering, SubmapView};
use coma_surfel::SurfelCloud;
use image::{RgbImage, imageops};
use std::collections::BTreeSet;
use std::path::Path;

/// Views of each agent that are kept as pictures.
const SHOWN: usize = 3;

/// Scores held-out views and others apart, before refinement and after; writes a few pictures to `renders/`.
pub fn score(read: &Read, out: &Path, options: &Options) -> anyhow::Result<(Pictures, Vec<Picture>)> {
    if options.views == 0 {
        return Ok((Pictures::default(), Vec::new()));
    }
    let lpips = match &options.lpips_model {
        Some(path) => Some(coma_encoder::Perceptual::open(path, &coma_encoder::RuntimeSettings::default())?),
        None => None,
    };
    let maps: Vec<Maps> = (0..read.facts.components.len())
        .map(|c| Maps::read(out, &read.facts, c))
        .collect::<Result<_, _>>()?;
    let plan = plan(read, options.views);
    let bar = progress::steps("rendering", plan.len() as u64);
    let renders = out.join("renders");
    std::fs::create_dir_all(&renders).with_context(|| renders.display().to_string())?;
    // Held out or not, refined or not.
    let mut scores: [[Vec<FrameScore>; 2]; 2] = Default::default();
    let mut shown = Vec::new();
    for view in plan {
        bar.inc(1);
        let source = &read.sources[view.agent];
        let frame = coma_dataset::sequence::rgbd_frame(&*source.sequence, view.frame)?;
        let maps = &maps[view.component];
        let refined = maps.refined.as_ref().map(|r| (&r.map, refined_pose(read, r, &view), r.render.clone()));
        let base = maps.base.as_ref().map(|map| (map, view.map_from_camera, RenderSettings::default()));
        for (kind, map) in [base, refined].into_iter().enumerate() {
            let Some((surfels, map_from_camera, settings)) = map else { continue };
            let camera_from_map = map_from_camera.inverse();
            let seen = coma_raster::seen(surfels, &camera_from_map, &frame.camera, &settings);
            let views = [SubmapView::new(&seen, camera_from_map)];
            let rendering = coma_raster::render(&views, &frame.camera, &settings, None);
            let recorded = frame.color.to_unit();
            let distance = match &lpips {
                Some(model) => Some(f64::from(model.distance(&rendering.color, &recorded)?)),
                None => None,
            };
            let score: FrameScore = score_frame(
                View { color: &rendering.color, depth_m: &rendering.depth_m },
                View { color: &recorded, depth_m: &frame.depth_m },
                distance,
            )?;
            scores[usize::from(view.held_out)][kind].push(score);
            if view.shown {
                let (suffix, map) = [("", "map"), ("-refined", "refined map")][kind];
                let name = format!("{}-{:06}{suffix}.png", source.agent, view.frame);
                let path = renders.join(&name);
                beside(&frame, &rendering).save(&path).with_context(|| path.display().to_string())?;
                let what = if view.held_out { "held out" } else { "mapped" };
                let caption = format!(
                    "{} frame {} ({what}), {map}: recorded, rendered, error x 4; depth likewise. PSNR {:.1} dB",
                    source.agent, view.frame, score.psnr_db
                );
                shown.push(Picture { path: format!("renders/{name}"), caption });
            }
        }
    }
    bar.finish_and_clear();
    let [training, held_out] = &scores;
    let pictures = Pictures {
        held_out: PictureScores::of(&held_out[0]),
        training: PictureScores::of(&training[0]),
        refined_held_out: PictureScores::of(&held_out[1]),
        refined_training: PictureScores::of(&training[1]),
    };
    Ok((pictures, shown))
}

/// A component's map as the run left it, and refined.
struct Maps {
    base: Option<SurfelCloud>,
    refined: Option<Refined>,
}

impl Maps {
    fn read(out: &Path, facts: &Facts, component: usize) -> anyhow::Result<Self> {
        let name = &facts.components[component].map;
        if name.is_empty() {
            return Ok(Maps { base: None, refined: None });
        }
        let base = folder::read_map(&out.join(name))?;
        Ok(Maps { base: Some(base), refined: folder::read(out, facts, component)? })
    }
}

/// Where the refined map sees a view. One that it was not refined by (a held-out one) takes the corrections of its
/// neighbours in time: its own picture is not looked at.
fn refined_pose(read: &Read, refined: &Refined, view: &Planned) -> Pose {
    let name = &read.sources[view.agent].agent;
    let at = |frame: usize| refined.poses.get(&(name.clone(), frame));
    if let Some(pose) = at(view.frame) {
        return *pose;
    }
    let Some(track) = read.tracks.get(&(view.agent, view.component)) else { return view.map_from_camera };
    let correction = |(frame, run): &(usize, Pose)| Some((*frame, run.inverse() * at(*frame)?));
    let before = track.iter().filter(|(f, _)| *f < view.frame).filter_map(correction).next_back();
    let after = track.iter().filter(|(f, _)| *f > view.frame).find_map(correction);
    let by = match (before, after) {
        (Some((a, before)), Some((b, after))) => {
            let share = (view.frame - a) as f64 / (b - a) as f64;
            before * se3::exp(&(se3::log(&(before.inverse() * after)) * share))
        }
        (Some((_, one)), None) | (None, Some((_, one))) => one,
        (None, None) => Pose::identity(),
    };
    view.map_from_camera * by
}

struct Planned {
    agent: usize,
    component: usize,
    frame: usize,
    map_from_camera: Pose,
    held_out: bool,
    shown: bool,
}

/// Evenly spread views of both kinds for each agent.
fn plan(read: &Read, views: usize) -> Vec<Planned> {
    let mut out = Vec::new();
    for agent in 0..read.sources.len() {
        let poses: Vec<_> = read
            .tracks
            .iter()
            .filter(|((a, _), _)| *a == agent)
            .flat_map(|((_, component), poses)| poses.iter().map(|(frame, pose)| (*component, *frame, *pose)))
            .collect();
        for held_out in [true, false] {
            let kind: Vec<_> =
                poses.iter().filter(|p| read.facts.is_held_out(agent, p.1) == held_out).collect();
            let picked = spread(kind.len(), views);
            let shown: BTreeSet<usize> = spread(picked.len(), SHOWN).into_iter().map(|i| picked[i]).collect();
            out.extend(picked.iter().map(|i| {
                let (component, frame, map_from_camera) = *kind[*i];
                Planned { agent, component, frame, map_from_camera, held_out, shown: shown.contains(i) }
            }));
        }
    }
    out
}

/// At most `wanted` of `0..count`, evenly spread.
fn spread(count: usize, wanted: usize) -> Vec<usize> {
    let wanted = wanted.min(count);
    (0..wanted).map(|i| (2 * i + 1) * count / (2 * wanted)).collect()
}

/// Recorded, rendered and their difference; colour above, depth below.
fn beside(frame: &RgbdFrame, rendering: &Rendering) -> RgbImage {
    let recorded = frame.color.to_unit();
    let color_error = Image::from_fn(recorded.width(), recorded.height(), |x, y| {
        std::array::from_fn(|c| 4.0 * (recorded[(x, y)][c] - rendering.color[(x, y)][c]).abs())
    });
    let far_m = frame.depth_m.pixels().iter().copied().fold(0.5f32, f32::max);
    let depth = |z: &f32| ramp(z / far_m, *z > 0.0);
    let depth_error = Image::from_fn(recorded.width(), recorded.height(), |x, y| {
        let (a, b) = (frame.depth_m[(x, y)], rendering.depth_m[(x, y)]);
        // White at 5 cm.
        if a > 0.0 && b > 0.0 { [((a - b).abs() / 0.05).min(1.0); 3] } else { [0.0; 3] }
    });
    let rows = [
        [recorded, rendering.color.clone(), color_error],
        [frame.depth_m.map(depth), rendering.depth_m.map(depth), depth_error],
    ];
    let (width, height) = (frame.camera.width, frame.camera.height);
    let mut out = RgbImage::new(3 * width, 2 * height);
    for (row, pictures) in rows.iter().enumerate() {
        for (column, picture) in pictures.iter().enumerate() {
            let bytes = picture.to_bytes();
            let part = RgbImage::from_fn(width, height, |x, y| image::Rgb(bytes[(x as usize, y as usize)]));
            imageops::replace(
                &mut out,
                &part,
                i64::from(column as u32 * width),
                i64::from(row as u32 * height),
            );
        }
    }
    out
}

/// A colour ramp from near (warm) to far (cold); black where there is no depth.
fn ramp(share: f32, measured: bool) -> [f32; 3] {
    if !measured {
        return [0.0; 3];
    }
    let t = share.clamp(0.0, 1.0);
    let tent = |centre: f32| (1.5 - (4.0 * t - centre).abs()).clamp(0.0, 1.0);
    [tent(1.0), tent(2.0), tent(3.0)]
}

#[cfg(test)]
mod tests {
    use super::spread;

    #[test]
    fn views_are_spread_evenly_and_never_twice() {
        assert_eq!(spread(10, 3), [1, 5, 8]);
        assert_eq!(spread(2, 5), [0, 1]);
        assert!(spread(0, 5).is_empty());
    }
}
