//! `coma bench raster`: what rendering and its derivatives cost, stage by stage.

use super::cpu::{median, process_ms};
use clap::Args;
use coma_geometry::{Intrinsics, Pose};
use coma_raster::{
    Outputs, PixelGradients, Projection, RenderSettings, Rendering, SubmapView, backward, render_only, scene,
};
use coma_surfel::SurfelCloud;
use serde::Serialize;
use std::fmt::Write as _;
use std::time::Instant;

/// Renders made-up scenes forward and backward: surfels scattered all over the picture, and a surface as mapping makes
/// it. Wall time, the least and the middle of all repeats, and processor time.
#[derive(Args)]
pub struct Arguments {
    /// Pixels.
    #[arg(long, default_value_t = 640)]
    width: u32,
    /// Pixels.
    #[arg(long, default_value_t = 480)]
    height: u32,
    /// Scattered surfels.
    #[arg(long, default_value_t = 100_000)]
    surfels: usize,
    /// Of the scenes.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Times that everything is measured.
    #[arg(long, default_value_t = 30)]
    repeats: usize,
    /// Threads; default: first one, then two.
    #[arg(long)]
    threads: Option<usize>,
    /// Prints JSON instead of a table.
    #[arg(long)]
    json: bool,
}

/// Hits that a pixel of the scattered scene is made for.
const HITS: f32 = 11.0;

/// Least and middle, milliseconds.
#[derive(Serialize)]
struct Times {
    least: f64,
    middle: f64,
}

impl Times {
    fn of(repeats: Vec<f64>) -> Self {
        Times { least: repeats.iter().copied().fold(f64::INFINITY, f64::min), middle: median(repeats) }
    }
}

#[derive(Serialize)]
struct Row {
    scene: &'static str,
    surfels: usize,
    width: u32,
    height: u32,
    seed: u64,
    threads: usize,
    /// Alpha over 1/255, before a pixel is done.
    hits_per_pixel: f64,
    project_ms: Times,
    sort_ms: Times,
    tile_ms: Times,
    blend_ms: Times,
    backward_ms: Times,
    /// Forward, for the losses of mapping, and backward.
    step_ms: Times,
    /// Processor time of that, of all threads: what it costs on a busy machine too.
    step_processor_ms: Times,
    /// Forward with every output.
    all_outputs_ms: Times,
}

/// Runs it.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let camera = scene::camera(arguments.width, arguments.height).validated()?;
    let scenes = [
        ("scattered", scene::scattered(&camera, arguments.surfels, HITS, arguments.seed)),
        ("surface", scene::surface(&camera, arguments.seed)),
    ];
    let mut rows = Vec::new();
    for (name, cloud) in &scenes {
        for threads in arguments.threads.map_or(vec![1, 2], |threads| vec![threads.max(1)]) {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
            rows.push(pool.install(|| measure(name, cloud, &camera, threads, arguments)));
        }
    }
    if arguments.json {
        println!("{}", serde_json::to_string_pretty(&rows)?);
    } else {
        print!("{}", table(&rows));
    }
    Ok(())
}

/// What `work` gives; its wall time is noted.
fn timed<T>(times: &mut Vec<f64>, work: impl FnOnce() -> T) -> T {
    let begin = Instant::now();
    let result = work();
    times.push(begin.elapsed().as_secs_f64() * 1e3);
    result
}

fn measure(
    scene: &'static str,
    cloud: &SurfelCloud,
    camera: &Intrinsics,
    threads: usize,
    arguments: &Arguments,
) -> Row {
    let views = [SubmapView::new(cloud, Pose::identity())];
    let settings = RenderSettings::default();
    let forward = |outputs| render_only(&views, camera, &settings, None, outputs);
    let [mut project, mut sort, mut tile, mut blend, mut back, mut step, mut processor, mut all] =
        [const { Vec::new() }; 8];
    let first = forward(Outputs::Optimising);
    let pixels = derivatives(&first);
    for _ in 0..arguments.repeats.max(1) {
        let projected = timed(&mut project, || Projection::of(&views, camera, &settings));
        let sorted = timed(&mut sort, || projected.sort());
        let tiled = timed(&mut tile, || sorted.tile());
        let rendering = timed(&mut blend, || tiled.blend(None, Outputs::Optimising));
        timed(&mut back, || backward(&views, camera, &settings, &rendering, &pixels));
        drop(rendering);
        let before_ms = process_ms();
        timed(&mut step, || {
            let rendering = forward(Outputs::Optimising);
            backward(&views, camera, &settings, &rendering, &pixels)
        });
        processor.push(process_ms() - before_ms);
        timed(&mut all, || forward(Outputs::All));
    }
    Row {
        scene,
        surfels: cloud.len(),
        width: camera.width,
        height: camera.height,
        seed: arguments.seed,
        threads,
        hits_per_pixel: first.hits as f64 / camera.pixels() as f64,
        project_ms: Times::of(project),
        sort_ms: Times::of(sort),
        tile_ms: Times::of(tile),
        blend_ms: Times::of(blend),
        backward_ms: Times::of(back),
        step_ms: Times::of(step),
        step_processor_ms: Times::of(processor),
        all_outputs_ms: Times::of(all),
    }
}

/// Of a loss that wants grey, opaque pixels two metres away.
fn derivatives(rendering: &Rendering) -> PixelGradients {
    PixelGradients {
        color: rendering.color.map(|c| c.map(|v| v - 0.5)),
        depth_m: rendering.depth_m.map(|d| 0.01 * (d - 2.0)),
        opacity: rendering.opacity.map(|o| o - 1.0),
    }
}

fn table(rows: &[Row]) -> String {
    let mut out = String::from(
        "Milliseconds, least / middle: wall time, and processor time of forward + backward.\n\n\
         | scene | surfels | pixels | hits per pixel | threads | project | sort | tile | blend | backward | forward + backward | processor | forward, every output |\n\
         |---|---|---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    for r in rows {
        let stages = [
            &r.project_ms,
            &r.sort_ms,
            &r.tile_ms,
            &r.blend_ms,
            &r.backward_ms,
            &r.step_ms,
            &r.step_processor_ms,
            &r.all_outputs_ms,
        ];
        let times: Vec<String> = stages.iter().map(|t| format!("{:.1} / {:.1}", t.least, t.middle)).collect();
        let _ = writeln!(
            out,
            "| {} | {} | {}x{} | {:.2} | {} | {} |",
            r.scene,
            r.surfels,
            r.width,
            r.height,
            r.hits_per_pixel,
            r.threads,
            times.join(" | ")
        );
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scattered_scene_has_about_as_many_hits_as_it_is_made_for() {
        let arguments = Arguments {
            width: 160,
            height: 120,
            surfels: 6250,
            seed: 1,
            repeats: 1,
            threads: Some(1),
            json: false,
        };
        let camera = scene::camera(160, 120);
        let cloud = scene::scattered(&camera, 6250, HITS, 1);
        let row = measure("scattered", &cloud, &camera, 1, &arguments);
        assert!((row.hits_per_pixel - 11.0).abs() < 0.7, "{}", row.hits_per_pixel);
        assert!(row.step_ms.least > 0.0 && row.step_ms.least <= row.step_ms.middle);
        assert!(table(&[row]).contains("| scattered | 6250 | 160x120 |"));
    }
}
