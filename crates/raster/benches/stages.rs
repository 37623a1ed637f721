//! Each stage of the rasteriser by itself: `cargo bench -p coma-raster`.

use coma_geometry::Pose;
use coma_raster::{
    Outputs, PixelGradients, Projection, RenderSettings, SubmapView, backward, render_only, scene,
};
use criterion::{BatchSize, Criterion, criterion_group, criterion_main};

fn stages(criterion: &mut Criterion) {
    let camera = scene::camera(640, 480);
    let settings = RenderSettings::default();
    for (name, cloud) in
        [("scattered", scene::scattered(&camera, 100_000, 11.0, 1)), ("surface", scene::surface(&camera, 1))]
    {
        let views = [SubmapView::new(&cloud, Pose::identity())];
        let projected = || Projection::of(&views, &camera, &settings);
        let mut group = criterion.benchmark_group(name);
        group.sample_size(20);
        group.bench_function("project", |b| b.iter(projected));
        group.bench_function("sort", |b| b.iter_batched(projected, |p| p.sort(), BatchSize::LargeInput));
        group.bench_function("tile", |b| {
            b.iter_batched(|| projected().sort(), |p| p.tile(), BatchSize::LargeInput)
        });
        for (name, outputs) in [("blend", Outputs::All), ("blend for losses", Outputs::Optimising)] {
            group.bench_function(name, |b| {
                b.iter_batched(
                    || projected().sort().tile(),
                    |p| p.blend(None, outputs),
                    BatchSize::LargeInput,
                )
            });
        }
        let rendering = render_only(&views, &camera, &settings, None, Outputs::Optimising);
        let pixels = PixelGradients {
            color: rendering.color.map(|c| c.map(|v| v - 0.4)),
            depth_m: rendering.depth_m.map(|d| 0.01 * (d - 2.0)),
            opacity: rendering.opacity.map(|o| o - 0.5),
        };
        group.bench_function("backward", |b| {
            b.iter(|| backward(&views, &camera, &settings, &rendering, &pixels))
        });
        group.finish();
    }
}

criterion_group!(benches, stages);
criterion_main!(benches);
