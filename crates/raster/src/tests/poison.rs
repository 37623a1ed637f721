//! Surfels that should not be, and those at the edge of what may be.

use super::*;

/// Renders and goes backward; everything that comes out is finite.
fn picture(surfels: &SurfelCloud) -> (Image<[f32; 3]>, SurfelGradients) {
    let views = [SubmapView::new(surfels, Pose::identity())];
    let settings = RenderSettings::default();
    let rendering = render(&views, &CAMERA, &settings, None);
    let mut gradients = backward(&views, &CAMERA, &settings, &rendering, &pixel_gradients());
    assert!(gradients.pose.iter().all(|v| v.is_finite()));
    let own = gradients.submaps.remove(0);
    let triples = own.center_m.iter().chain(&own.rotation).chain(&own.color).flatten();
    let all = triples.chain(own.scale_m.iter().flatten()).chain(&own.opacity);
    assert!(all.into_iter().all(|v| v.is_finite()));
    let images =
        [&rendering.depth_m, &rendering.median_depth_m, &rendering.depth_spread_m, &rendering.opacity];
    assert!(images.iter().flat_map(|image| image.pixels()).all(|v| v.is_finite()));
    let triples = rendering.color.pixels().iter().chain(rendering.normal.pixels());
    assert!(triples.flatten().all(|v| v.is_finite()));
    (rendering.color, own)
}

/// Surfels of which nothing may be seen.
fn impossible(good: Surfel) -> Vec<Surfel> {
    let mut out = Vec::new();
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, f32::MIN] {
        out.push(Surfel { center_m: [bad, 0.0, 2.0], ..good });
        out.push(Surfel { center_m: [0.0, bad, 2.0], ..good });
        out.push(Surfel { opacity: bad, ..good });
    }
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        out.push(Surfel { center_m: [0.0, 0.0, bad], ..good });
        out.push(Surfel { rotation_wxyz: [bad, 0.0, 0.0, 0.0], ..good });
        out.push(Surfel { scale_m: [bad, 0.1], ..good });
        out.push(Surfel { scale_m: [0.1, bad], ..good });
        out.push(Surfel { color: [bad, 0.0, 0.0], ..good });
    }
    for scale in [0.0, -0.1, 1e-45] {
        out.push(Surfel { scale_m: [scale, 0.1], ..good });
    }
    out.push(Surfel { rotation_wxyz: [0.0; 4], ..good });
    out.push(Surfel { center_m: [0.0, 0.0, -1.0], ..good });
    out.push(Surfel { center_m: [0.0, 0.0, 0.0], ..good });
    out.push(Surfel { opacity: 0.0, ..good });
    out.push(Surfel { opacity: -1.0, ..good });
    out.push(Surfel { opacity: 1.0001, ..good });
    out
}

#[test]
fn poisoned_surfels_are_left_out_and_spoil_nothing() {
    let clean = surfels(1, 60);
    let mut poisoned = clean.clone();
    let good = clean.get(0);
    let bad = impossible(good);
    bad.iter().for_each(|s| poisoned.push(*s));
    let ((expected, _), (found, gradients)) = (picture(&clean), picture(&poisoned));
    assert!(expected == found, "the picture changed");
    for i in 60..poisoned.len() {
        assert_eq!(gradients.center_m[i], [0.0; 3], "{:?}", poisoned.get(i));
        assert_eq!(gradients.opacity[i], 0.0, "{:?}", poisoned.get(i));
    }
    // The comparison sees one that is not bad.
    poisoned.push(Surfel { center_m: [0.0, 0.0, 0.9], ..good });
    assert!(expected != picture(&poisoned).0);
}

#[test]
fn surfels_at_the_edge_of_the_possible_stay_finite() {
    let mut cloud = surfels(1, 60);
    let good = cloud.get(0);
    for scale in [f32::MIN_POSITIVE, 1e-20, 1e-6, 1e3, 1e18] {
        cloud.push(Surfel { scale_m: [scale; 2], ..good });
        cloud.push(Surfel { scale_m: [scale, 0.1], ..good });
    }
    cloud.push(Surfel { opacity: 1.0, ..good });
    cloud.push(Surfel { opacity: 1.0 / 255.0 + 1e-9, ..good });
    cloud.push(Surfel { center_m: [0.0, 0.0, 0.0501], scale_m: [1.0; 2], ..good });
    cloud.push(Surfel { center_m: [1e6, 0.0, 1e6], ..good });
    cloud.push(Surfel { center_m: [0.0, 0.0, 1e12], scale_m: [1e12; 2], ..good });
    picture(&cloud);
}

#[test]
fn surfels_seen_edge_on_agree_with_the_oracle() {
    let mut r = Random(5);
    // The normal is at right angles to the ray of the centre, or all but.
    let disc = |off: f32, r: &mut Random| {
        let z = r.between(1.0, 2.0);
        let center = Vector3::new(r.between(-0.3, 0.3) * z, r.between(-0.25, 0.25) * z, z);
        let across = center.cross(&Vector3::new(r.between(-1.0, 1.0), r.between(-1.0, 1.0), 0.1)).normalize();
        let normal = (across + center.normalize() * off).normalize();
        let q = UnitQuaternion::rotation_between(&Vector3::z(), &normal).unwrap();
        Surfel {
            center_m: center.into(),
            rotation_wxyz: [q.w, q.i, q.j, q.k],
            scale_m: [r.between(0.03, 0.2), r.between(0.03, 0.2)],
            opacity: r.between(0.3, 0.9),
            color: [r.next(), r.next(), r.next()],
        }
    };
    let cloud: SurfelCloud =
        [0.0, 1e-6, 1e-3, 0.02].into_iter().cycle().take(40).map(|off| disc(off, &mut r)).collect();
    let views = [SubmapView::new(&cloud, Pose::identity())];
    for settings in [smooth(), RenderSettings::default()] {
        let rendering = render(&views, &CAMERA, &settings, None);
        let oracle = oracle::render(&oracle::in_camera(&views), &CAMERA, &settings);
        let (_, off) = worst_difference(&rendering, &oracle);
        // Rays within the disc's plane are ill-conditioned: single precision sees them elsewhere.
        assert!(off <= 16, "{off} pixels off");
        assert!(rendering.hits > 200, "{} hits", rendering.hits);
    }
    picture(&cloud);
}
