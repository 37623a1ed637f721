//! The builtin descriptor on a real sequence, scored by true overlap of views.

use coma_frame::Image;
use coma_geometry::nalgebra::{Quaternion, Translation3, UnitQuaternion};
use coma_geometry::{Intrinsics, Pose};
use coma_place::{Builtin, Descriptor, Encoder, similarity};
use std::path::{Path, PathBuf};

/// The folder `shared`: `COMA_SHARED`, or beside the repository.
fn shared() -> PathBuf {
    if let Some(folder) = std::env::var_os("COMA_SHARED") {
        return folder.into();
    }
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .ancestors()
        .map(|folder| folder.join("shared"))
        .find(|shared| shared.join("data").is_dir())
        .expect("no shared/data beside the repository and COMA_SHARED is not set")
}

struct Frame {
    color: Image<[u8; 3]>,
    depth_m: Image<f32>,
    map_from_camera: Pose,
}

/// Every `every`-th frame of a TUM-layout sequence.
fn frames(folder: &Path, every: usize) -> (Intrinsics, Vec<Frame>) {
    let lines = |name: &str| -> Vec<Vec<String>> {
        let text = std::fs::read_to_string(folder.join(name)).unwrap();
        text.lines()
            .filter(|l| !l.starts_with('#') && !l.trim().is_empty())
            .map(|l| l.split_whitespace().map(str::to_owned).collect())
            .collect()
    };
    let number = |text: &String| text.parse::<f64>().unwrap();
    let c: Vec<f64> = lines("calibration.txt")[0].iter().map(number).collect();
    let camera =
        Intrinsics { width: c[0] as u32, height: c[1] as u32, fx: c[2], fy: c[3], cx: c[4], cy: c[5] };
    let truth: Vec<Vec<f64>> =
        lines("groundtruth.txt").iter().map(|l| l.iter().map(number).collect()).collect();
    let read = |row: Vec<String>| {
        let stamp = number(&row[0]);
        let p = truth.iter().min_by(|a, b| (a[0] - stamp).abs().total_cmp(&(b[0] - stamp).abs())).unwrap();
        let rotation = UnitQuaternion::from_quaternion(Quaternion::new(p[7], p[4], p[5], p[6]));
        let color = image::open(folder.join(&row[1])).unwrap().to_rgb8();
        let depth = image::open(folder.join(&row[3])).unwrap().to_luma16();
        let (w, h) = (color.width() as usize, color.height() as usize);
        Frame {
            color: Image::from_pixels(w, h, color.pixels().map(|p| p.0).collect()).unwrap(),
            depth_m: Image::from_pixels(
                w,
                h,
                depth.pixels().map(|p| (p.0[0] as f64 / c[6]) as f32).collect(),
            )
            .unwrap(),
            map_from_camera: Pose::from_parts(Translation3::new(p[1], p[2], p[3]), rotation),
        }
    };
    (camera, lines("associations.txt").into_iter().step_by(every).map(read).collect())
}

/// Share of one frame's depth points that the other sees at its own depth.
fn overlap(camera: &Intrinsics, from: &Frame, into: &Frame) -> f64 {
    let into_from_from = into.map_from_camera.inv_mul(&from.map_from_camera);
    let (mut points, mut seen) = (0, 0);
    for y in (8..camera.height as usize).step_by(16) {
        for x in (8..camera.width as usize).step_by(16) {
            let z = from.depth_m[(x, y)];
            if !(z > 0.3 && z < 6.0) {
                continue;
            }
            points += 1;
            let p = into_from_from * camera.back_project(x as f64, y as f64, z as f64);
            let Some(pixel) = camera.project(&p).filter(|_| p.z > 0.1) else { continue };
            let (u, v) = (pixel.x.round(), pixel.y.round());
            if u >= 0.0 && v >= 0.0 && u < camera.width as f64 && v < camera.height as f64 {
                let d = into.depth_m[(u as usize, v as usize)] as f64;
                seen += (d > 0.0 && (d - p.z).abs() < 0.1 + 0.03 * p.z) as usize;
            }
        }
    }
    seen as f64 / points.max(1) as f64
}

/// Gamma, colour gain, an 80 % crop.
fn perturbed(image: &Image<[u8; 3]>, kind: usize) -> Image<[u8; 3]> {
    match kind {
        0 => image.map(|c| c.map(|v| (255.0 * (v as f32 / 255.0).powf(1.8)) as u8)),
        1 => image.map(|c| [(c[0] as f32 * 1.25).min(255.0) as u8, c[1], (c[2] as f32 * 0.75) as u8]),
        _ => {
            let (w, h) = (image.width(), image.height());
            Image::from_fn(w - w / 5, h - h / 5, |x, y| image[(x + w / 10, y + h / 10)])
        }
    }
}

#[test]
#[ignore = "needs the shared data folder"]
fn the_builtin_descriptor_finds_places_of_a_kitchen() {
    const EVERY: usize = 5;
    let (camera, frames) = frames(&shared().join("data/kitchen"), EVERY);
    let encoder = Builtin::default();
    let describe = |image: &Image<[u8; 3]>| encoder.describe(image, None).unwrap();
    let descriptors: Vec<Descriptor> = frames.iter().map(|f| describe(&f.color)).collect();
    let n = frames.len();
    let mut pairs = Vec::new();
    let (mut queries, mut hits) = (0, 0);
    for i in 0..n {
        let mut best = (f32::NEG_INFINITY, 0.0);
        let mut has_match = false;
        for j in (0..n).filter(|j| i.abs_diff(*j) * EVERY > 25) {
            let common =
                overlap(&camera, &frames[i], &frames[j]).min(overlap(&camera, &frames[j], &frames[i]));
            let s = similarity(&descriptors[i], &descriptors[j]).unwrap();
            has_match |= common >= 0.4;
            if s > best.0 {
                best = (s, common);
            }
            if i < j {
                pairs.push((s, common));
            }
        }
        queries += has_match as usize;
        hits += (has_match && best.1 >= 0.4) as usize;
    }
    pairs.sort_by(|a, b| b.0.total_cmp(&a.0));
    let positives = pairs.iter().filter(|p| p.1 >= 0.4).count() as f64;
    let (mut found, mut precision) = (0.0, 0.0);
    for (rank, pair) in pairs.iter().enumerate() {
        if pair.1 >= 0.4 {
            found += 1.0;
            precision += found / (rank + 1) as f64;
        }
    }
    let best_wrong = pairs.iter().find(|p| p.1 < 0.1).unwrap().0;
    let without_false = pairs.iter().filter(|p| p.1 >= 0.4 && p.0 > best_wrong).count() as f64 / positives;
    let (mut perturbations, mut kept) = (0, 0);
    for i in (0..n).step_by(4) {
        for kind in 0..3 {
            let query = describe(&perturbed(&frames[i].color, kind));
            let score = |j: &usize| similarity(&query, &descriptors[*j]).unwrap();
            let best = (0..n).max_by(|a, b| score(a).total_cmp(&score(b))).unwrap();
            perturbations += 1;
            kept += (best.abs_diff(i) * EVERY <= 12) as usize;
        }
    }
    let recall_at_1 = hits as f64 / queries as f64;
    let average_precision = precision / positives;
    let perturbed_hit = kept as f64 / perturbations as f64;
    let theta = encoder.thresholds().theta_sim;
    let share = |least: f64, most: f64| {
        let among: Vec<_> = pairs.iter().filter(|p| p.1 >= least && p.1 < most).collect();
        among.iter().filter(|p| p.0 > theta).count() as f64 / among.len() as f64
    };
    println!(
        "recall@1 {recall_at_1:.3}, AP {average_precision:.3}, recall without a false pair {without_false:.3}, perturbed hit {perturbed_hit:.3}; above theta_sim: {:.2} of overlap >= 0.4, {:.2} of overlap < 0.1",
        share(0.4, 2.0),
        share(0.0, 0.1)
    );
    assert!(recall_at_1 >= 0.75, "{recall_at_1}");
    assert!(average_precision >= 0.65, "{average_precision}");
    assert!(without_false >= 0.5, "{without_false}");
    assert!(perturbed_hit >= 0.97, "{perturbed_hit}");
    assert!(share(0.4, 2.0) >= 0.95 && share(0.0, 0.1) <= 0.25);
}
