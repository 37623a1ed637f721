//! The same picture and gradients, whoever computes them.

use super::*;

/// Every image and gradient as one row of numbers each, by name.
fn numbers(rendering: &Rendering, gradients: Option<&Gradients>) -> Vec<(&'static str, Vec<f32>)> {
    let flat = |image: &Image<[f32; 3]>| image.pixels().concat();
    let near = rendering.near_surface.iter().flat_map(|near| near.pixels()).map(|n| *n as u8 as f32);
    let of = |f: fn(&SurfelGradients) -> Vec<f32>| {
        gradients.iter().flat_map(|g| &g.submaps).flat_map(f).collect::<Vec<f32>>()
    };
    vec![
        ("colour", flat(&rendering.color)),
        ("depth", rendering.depth_m.pixels().to_vec()),
        ("opacity", rendering.opacity.pixels().to_vec()),
        ("near", near.collect()),
        ("median", rendering.median_depth_m.pixels().to_vec()),
        ("surface", rendering.surface_depth_m.pixels().to_vec()),
        ("intensity", rendering.surface_intensity.pixels().to_vec()),
        ("spread", rendering.depth_spread_m.pixels().to_vec()),
        ("normal", flat(&rendering.normal)),
        ("by centre", of(|g| g.center_m.concat())),
        ("by rotation", of(|g| g.rotation.concat())),
        ("by scale", of(|g| g.scale_m.concat())),
        ("by opacity", of(|g| g.opacity.clone())),
        ("by colour", of(|g| g.color.concat())),
        ("by pose", gradients.iter().flat_map(|g| g.pose.iter()).map(|v| *v as f32).collect()),
    ]
}

/// A scene of several runs and chunks on a picture whose sides are no multiples of a tile's.
fn run(arch: pulp::Arch, outputs: Outputs) -> (u64, Vec<(&'static str, Vec<f32>)>) {
    let camera = scene::camera(150, 101);
    let (one, two) = (scene::scattered(&camera, 15_000, 9.0, 3), scene::scattered(&camera, 5_000, 3.0, 4));
    let views = [SubmapView::new(&one, Pose::identity()), SubmapView::new(&two, pose())];
    let settings = RenderSettings::default();
    let depth = Image::from_fn(150, 101, |x, y| 1.0 + ((x * 7 + y * 13) % 31) as f32 * 0.1);
    let noise = DepthNoise { base_m: 0.001, quadratic_per_m: 0.002 };
    let test = GrowthTest { observed_depth_m: &depth, noise, sigma_factor: 3.0, relative: 0.01 };
    let rendering = forward::render_on(arch, &views, &camera, &settings, Some(&test), outputs);
    let by = |k: f32| Image::from_fn(150, 101, |x, y| ((x + 150 * y) as f32 * k).sin());
    let pixels = PixelGradients {
        color: Image::from_fn(150, 101, |x, y| [0.7, 1.3, 2.1].map(|k| ((x + 150 * y) as f32 * k).sin())),
        depth_m: by(0.37),
        opacity: by(0.91),
    };
    let gradients = outputs.blended().then(|| backward(&views, &camera, &settings, &rendering, &pixels));
    (rendering.hits, numbers(&rendering, gradients.as_ref()))
}

#[test]
fn the_same_bits_come_from_any_number_of_threads() {
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| run(pulp::Arch::new(), Outputs::All))
    };
    let one = on(1);
    for threads in [2, 3] {
        let other = on(threads);
        assert_eq!(one.0, other.0);
        for ((name, a), (_, b)) in one.1.iter().zip(&other.1) {
            let same = a.len() == b.len() && a.iter().zip(b).all(|(a, b)| a.to_bits() == b.to_bits());
            assert!(same, "{name} with {threads} threads");
        }
    }
}

/// Root mean square of the differences over that of the values.
fn difference(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len());
    let square = |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>();
    let apart = square(&mut a.iter().zip(b).map(|(a, b)| *a as f64 - *b as f64));
    (apart / square(&mut a.iter().map(|v| *v as f64)).max(1e-30)).sqrt()
}

#[test]
fn every_instruction_set_sees_the_same() {
    let [portable, others @ ..] = &crate::architectures()[..] else {
        panic!("there is always the portable one")
    };
    let truth = run(*portable, Outputs::All);
    for arch in others {
        let found = run(*arch, Outputs::All);
        // A hit at the least alpha may fall to either side.
        assert!(found.0.abs_diff(truth.0) <= 20, "{arch:?}: {} hits, {}", found.0, truth.0);
        for ((name, a), (_, b)) in truth.1.iter().zip(&found.1) {
            // The median jumps from one surfel to the next, the surface from one to another, and near is yes or no.
            let limit = if ["median", "surface", "intensity", "near"].contains(name) { 0.02 } else { 2e-3 };
            let found = difference(a, b);
            assert!(found < limit, "{arch:?}: {name} differs by {found}");
        }
    }
    // And a comparison of another scene fails.
    let (a, b) = (&truth.1[0].1, &truth.1[0].1.iter().rev().copied().collect::<Vec<_>>());
    assert!(difference(a, b) > 0.1);
}

#[test]
fn what_is_not_wanted_is_empty_and_changes_nothing_else() {
    let all = run(pulp::Arch::new(), Outputs::All);
    for outputs in [Outputs::Tracking, Outputs::Optimising] {
        let some = run(pulp::Arch::new(), outputs);
        assert_eq!(all.0, some.0);
        for ((name, a), (_, b)) in all.1.iter().zip(&some.1) {
            let wanted = match *name {
                "surface" | "intensity" => outputs.surface(),
                "median" | "spread" | "normal" => outputs.detail(),
                "opacity" | "near" => true,
                // Colour, depth and gradients.
                _ => outputs.blended(),
            };
            assert!(if wanted { a == b } else { b.is_empty() }, "{name} for {outputs:?}");
        }
    }
}
