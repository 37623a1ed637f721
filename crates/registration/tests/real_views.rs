//! Registration of real views: recall on wide baselines, and no false accept.

mod support;

use coma_geometry::se3;
use coma_registration::{Outcome, Prepared, Settings, Side, View, align, align_prepared};
use support::{Sequence, shared};

#[test]
#[ignore = "needs the shared data folder"]
fn wide_baselines_of_a_kitchen_are_registered_and_none_wrongly() {
    let kitchen = Sequence::open(&shared().join("data/kitchen"));
    let pairs = std::fs::read_to_string(shared().join("bench/kitchen_pairs.json")).unwrap();
    let pairs: serde_json::Value = serde_json::from_str(&pairs).unwrap();
    let settings = Settings::default();
    let (mut good, mut wrong, mut count) = (0, 0, 0);
    for pair in pairs.as_array().unwrap() {
        let index = |key: &str| pair[key].as_u64().unwrap() as usize;
        let (s, t) = (index("src"), index("dst"));
        let truth = kitchen.target_from_source(s, t);
        let (source, target) = (kitchen.view(s), kitchen.view(t));
        let start = std::time::Instant::now();
        let outcome = align(&source, &target, &settings, 7);
        let ms = start.elapsed().as_secs_f64() * 1e3;
        count += 1;
        match &outcome {
            Outcome::Accepted(a) => {
                let (m, rad) = se3::distance(&truth, &a.target_from_source);
                let degrees = rad.to_degrees();
                good += (degrees < 3.0 && m < 0.05) as usize;
                wrong += (degrees > 5.0 || m > 0.10) as usize;
                println!(
                    "{s:3} {t:3} overlap {:.2} | {degrees:.2} deg {:.1} cm, overlap {:.2}, conflicts {:.3}, correlation {:.2}, ratio {:.4}, inliers {}, samples {}, sigma {:.4} m, {ms:.0} ms",
                    pair["overlap"].as_f64().unwrap(),
                    m * 100.0,
                    a.overlap,
                    a.conflicts,
                    a.photometric_correlation.unwrap_or(f64::NAN),
                    a.eigenvalue_ratio,
                    a.inliers,
                    a.effective_samples,
                    (a.information.try_inverse().unwrap().fixed_view::<3, 3>(0, 0).trace() / 3.0).sqrt(),
                );
            }
            Outcome::Rejected(reason) => {
                println!("{s:3} {t:3} overlap {} | {reason} {ms:.0} ms", pair["overlap"])
            }
        }
    }
    println!("{good} of {count} within 3 degrees and 5 cm, {wrong} accepted wrongly");
    assert!(good >= 16, "{good} of {count}");
    assert_eq!(wrong, 0);
}

#[test]
#[ignore = "needs the shared data folder"]
fn views_that_share_nothing_are_never_registered() {
    let kitchen = Sequence::open(&shared().join("data/kitchen"));
    let living_room = Sequence::open(&shared().join("data/living-room/agent-0"));
    let settings = Settings::default();
    let prepared = |view: &View| Prepared::new(view, &settings, Side::Source).unwrap();
    let rooms: Vec<Prepared> = (0..240).step_by(80).map(|i| prepared(&living_room.view(i))).collect();
    for i in (0..500).step_by(100) {
        let view = prepared(&kitchen.view(i));
        for (j, room) in rooms.iter().enumerate() {
            let outcome = align_prepared(&view, room, &settings, 7);
            assert!(outcome.alignment().is_none(), "kitchen {i}, living room {}: {outcome:?}", j * 80);
        }
    }
    // Frames of one kitchen whose views overlap by less than 17 %: most alike of those that are not one place.
    let pairs = [(75, 450), (50, 425), (75, 175), (325, 450), (50, 375), (25, 375), (100, 200), (200, 375)];
    for (i, j) in pairs {
        let outcome = align_prepared(&prepared(&kitchen.view(i)), &prepared(&kitchen.view(j)), &settings, 7);
        assert!(outcome.alignment().is_none(), "kitchen {i} and {j}: {outcome:?}");
    }
}
