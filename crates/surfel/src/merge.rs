//! Submaps as one cloud in the map. What a submap before already shows is dropped.
//!
//! The rule: space is cut into cubes, and each cube into six by the direction that normals face. Where the
//! discs of submaps before cover a cube's face, surfels of later ones are dropped; a submap never drops its
//! own. Walls seen from both sides keep both sides.

use crate::{Surfel, SurfelCloud};
use coma_geometry::Pose;
use std::collections::HashMap;

/// A submap and where it lies.
#[derive(Clone, Copy, Debug)]
pub struct Part<'a> {
    /// In the submap's frame.
    pub surfels: &'a SurfelCloud,
    /// Where the submap lies.
    pub map_from_submap: Pose,
}

/// When two surfels show the same.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MergeSettings {
    /// Side of a cube, metres. Default: 0.02, a little over the error of a good loop.
    pub cell_m: f64,
    /// A cube is shown when the discs of submaps before (to one standard deviation, times opacity) have so
    /// many times the area of its face. Default: 0.5.
    pub coverage: f32,
}

impl Default for MergeSettings {
    fn default() -> Self {
        MergeSettings { cell_m: 0.02, coverage: 0.5 }
    }
}

/// A cube, and which of the six directions a normal faces most.
type Cell = ([i32; 3], u8);

/// One cloud in the map, submap by submap in the order given. Surfels that are not finite are left out.
pub fn merge(parts: &[Part<'_>], settings: &MergeSettings) -> SurfelCloud {
    let face_m2 = (settings.cell_m * settings.cell_m) as f32;
    let mut shown_m2: HashMap<Cell, f32> = HashMap::new();
    let mut out = SurfelCloud::default();
    for part in parts {
        let mut own_m2: HashMap<Cell, f32> = HashMap::new();
        for surfel in part.surfels.iter().filter(Surfel::is_finite) {
            let in_map = surfel.moved(&part.map_from_submap);
            let cell = cell(&in_map, settings.cell_m);
            if shown_m2.get(&cell).is_some_and(|m2| *m2 >= settings.coverage * face_m2) {
                continue;
            }
            let disc_m2 = std::f32::consts::PI * surfel.scale_m[0] * surfel.scale_m[1] * surfel.opacity;
            *own_m2.entry(cell).or_default() += disc_m2.min(face_m2);
            out.push(in_map);
        }
        for (cell, m2) in own_m2 {
            *shown_m2.entry(cell).or_default() += m2;
        }
    }
    out
}

fn cell(surfel: &Surfel, cell_m: f64) -> Cell {
    // Beyond what 32 bits count, `as` saturates: far surfels share a cell.
    let cube = surfel.center_m.map(|v| (f64::from(v) / cell_m).floor() as i32);
    let normal = surfel.rotation().column(2).into_owned();
    let axis = normal.iamax();
    (cube, 2 * axis as u8 + u8::from(normal[axis] < 0.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One square metre of wall at z = 0 in surfels one centimetre apart, facing +z or -z.
    fn wall(facing_back: bool) -> SurfelCloud {
        let rotation_wxyz = if facing_back { [0.0, 1.0, 0.0, 0.0] } else { [1.0, 0.0, 0.0, 0.0] };
        let surfel = |i: usize| Surfel {
            center_m: [0.01 * (i % 100) as f32 + 0.005, 0.01 * (i / 100) as f32 + 0.005, 0.0],
            rotation_wxyz,
            scale_m: [0.01, 0.01],
            opacity: 0.9,
            color: [0.5; 3],
        };
        (0..10_000).map(surfel).collect()
    }

    fn at(surfels: &SurfelCloud, x_m: f64, z_m: f64) -> Part<'_> {
        Part { surfels, map_from_submap: Pose::translation(x_m, 0.0, z_m) }
    }

    #[test]
    fn what_a_submap_before_shows_is_dropped_and_what_is_new_is_kept() {
        let wall = wall(false);
        let merged = merge(&[at(&wall, 0.0, 0.005), at(&wall, 0.5, 0.01)], &MergeSettings::default());
        // The second wall adds its right half.
        assert!((14_800..=15_200).contains(&merged.len()), "{}", merged.len());
        let alone = merge(&[at(&wall, 0.0, 0.005)], &MergeSettings::default());
        assert_eq!(alone.len(), wall.len(), "a submap never drops its own");
    }

    #[test]
    fn walls_apart_and_walls_seen_from_both_sides_are_kept() {
        let (front, back) = (wall(false), wall(true));
        let merged = merge(
            &[at(&front, 0.0, 0.005), at(&front, 0.0, 0.105), at(&back, 0.0, 0.005)],
            &MergeSettings::default(),
        );
        assert_eq!(merged.len(), 3 * front.len());
    }

    #[test]
    fn faint_surfels_do_not_hide_others() {
        let mut faint = wall(false);
        faint.opacity.fill(0.05);
        let solid = wall(false);
        let merged = merge(&[at(&faint, 0.0, 0.005), at(&solid, 0.0, 0.005)], &MergeSettings::default());
        assert_eq!(merged.len(), 2 * solid.len());
    }

    #[test]
    fn order_is_kept_and_values_that_are_not_finite_are_left_out() {
        let mut wall = wall(false);
        wall.center_m[0][0] = f32::NAN;
        let merged = merge(&[at(&wall, 0.0, 0.005)], &MergeSettings::default());
        assert_eq!(merged.len(), wall.len() - 1);
        assert_eq!(merged.center_m[0][0], wall.center_m[1][0]);
    }
}
