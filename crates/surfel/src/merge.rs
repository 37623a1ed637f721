//! Submaps as one cloud in the map. Where several show the same surface, the one that shows it in most detail stays.
//!
//! The rule: space is cut into cubes, and each cube into six by the direction that normals face. Among the submaps
//! whose discs cover a cube's face, the first of those with about the finest discs keeps its surfels there; the others'
//! are dropped. Cubes before and behind the surface count too, as errors of depth cross their borders. Walls seen from
//! both sides keep both sides.

use crate::{Surfel, SurfelCloud};
use coma_geometry::Pose;
use std::borrow::Cow;
use std::collections::HashMap;
use std::convert::Infallible;

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
    /// A submap shows a cube when its discs (to one standard deviation, times opacity) have so many times the area of
    /// the cube's face. Default: 0.5.
    pub coverage: f32,
    /// Discs are about the finest when they have at most so many times the area of the finest. Default: 1.5.
    pub detail: f32,
}

impl Default for MergeSettings {
    fn default() -> Self {
        MergeSettings { cell_m: 0.02, coverage: 0.5, detail: 1.5 }
    }
}

/// What so many submaps show is in memory at a time: with more of them space is looked at in parts, one after the other.
const PARTS_AT_ONCE: usize = 64;

/// A cube, and which of the six directions a normal faces most.
type Cell = ([i32; 3], u8);

/// What one submap has in a cube.
#[derive(Clone, Copy)]
struct Share {
    part: u32,
    /// Of its discs, times opacity, each at most the cube's face.
    shown_m2: f32,
    /// Of its discs.
    discs_m2: f32,
    count: u32,
}

impl Share {
    fn add(&mut self, other: &Share) {
        self.shown_m2 += other.shown_m2;
        self.discs_m2 += other.discs_m2;
        self.count += other.count;
    }
}

/// One cloud in the map, submap by submap in the order given. Surfels that are not finite are left out.
pub fn merge(parts: &[Part<'_>], settings: &MergeSettings) -> SurfelCloud {
    let part = |i: usize| Ok::<_, Infallible>((Cow::Borrowed(parts[i].surfels), parts[i].map_from_submap));
    match merge_each(parts.len(), part, settings) {
        Ok((map, _)) => map,
        Err(never) => match never {},
    }
}

/// As [`merge`], of `count` submaps that need not be in memory together: `part` is asked for each, in order, for
/// its surfels and `map_from_submap`; twice, and once more for every 64 submaps. Beside the map: how many surfels of each
/// submap are kept.
pub fn merge_each<'a, E>(
    count: usize,
    mut part: impl FnMut(usize) -> Result<(Cow<'a, SurfelCloud>, Pose), E>,
    settings: &MergeSettings,
) -> Result<(SurfelCloud, Vec<usize>), E> {
    let face_m2 = (settings.cell_m * settings.cell_m) as f32;
    let rounds = count.div_ceil(PARTS_AT_ONCE);
    let mut keepers = Vec::new();
    for round in 0..rounds {
        let mut shares = Vec::new();
        for i in 0..count {
            let (surfels, map_from_submap) = part(i)?;
            let mut of_part: HashMap<Cell, Share> = HashMap::new();
            for surfel in placed(&surfels, &map_from_submap) {
                let cell = cell(&surfel, settings.cell_m);
                if column(&cell) % rounds != round {
                    continue;
                }
                let disc_m2 = std::f32::consts::PI * surfel.scale_m[0] * surfel.scale_m[1];
                let shown_m2 = (disc_m2 * surfel.opacity).min(face_m2);
                let share = Share { part: i as u32, shown_m2, discs_m2: disc_m2, count: 1 };
                of_part.entry(cell).and_modify(|sum| sum.add(&share)).or_insert(share);
            }
            shares.extend(of_part);
        }
        keepers.extend(keepers_among(shares, face_m2, settings));
    }
    keepers.sort_unstable_by_key(|(cell, _)| *cell);
    let (mut out, mut kept) = (SurfelCloud::default(), vec![0; count]);
    for i in 0..count {
        let (surfels, map_from_submap) = part(i)?;
        for surfel in placed(&surfels, &map_from_submap) {
            let cell = cell(&surfel, settings.cell_m);
            let keeper =
                keepers.binary_search_by_key(&cell, |(cell, _)| *cell).ok().and_then(|at| keepers[at].1);
            if keeper.is_none_or(|keeper| keeper == i as u32) {
                out.push(surfel);
                kept[i] += 1;
            }
        }
    }
    Ok((out, kept))
}

/// Surfels in the map.
fn placed<'a>(surfels: &'a SurfelCloud, map_from_submap: &'a Pose) -> impl Iterator<Item = Surfel> + 'a {
    surfels.iter().filter(Surfel::is_finite).map(|surfel| surfel.moved(map_from_submap))
}

/// A number that cubes before and behind a surface have in common: what decides on them lies together.
fn column((cube, side): &Cell) -> usize {
    let axis = *side as usize / 2;
    let across = [cube[(axis + 1) % 3], cube[(axis + 2) % 3]].map(|v| v as u32);
    (across[0].wrapping_mul(73_856_093) ^ across[1].wrapping_mul(19_349_663)) as usize
}

/// Which submap keeps its surfels in each cube, sorted by cube; `None` if none shows it.
fn keepers_among(
    mut shares: Vec<(Cell, Share)>,
    face_m2: f32,
    settings: &MergeSettings,
) -> Vec<(Cell, Option<u32>)> {
    shares.sort_unstable_by_key(|(cell, share)| (*cell, share.part));
    let cells = shares.chunk_by(|a, b| a.0 == b.0);
    cells.map(|of_cell| (of_cell[0].0, keeper(&shares, of_cell[0].0, face_m2, settings))).collect()
}

/// Which submap keeps its surfels in a cube; `None` if none shows it. `shares` are sorted by cube, then submap.
fn keeper(shares: &[(Cell, Share)], cell: Cell, face_m2: f32, settings: &MergeSettings) -> Option<u32> {
    let (cube, side) = cell;
    let axis = side as usize / 2;
    let mut sums: Vec<Share> = Vec::new();
    for step in [0, -1, 1] {
        let mut near = cube;
        near[axis] = near[axis].saturating_add(step);
        let first = shares.partition_point(|(cell, _)| *cell < (near, side));
        for (_, share) in shares[first..].iter().take_while(|(cell, _)| *cell == (near, side)) {
            match sums.iter_mut().find(|s| s.part == share.part) {
                Some(sum) => sum.add(share),
                None => sums.push(*share),
            }
        }
    }
    sums.retain(|s| s.shown_m2 >= settings.coverage * face_m2);
    let disc_m2 = |s: &Share| s.discs_m2 / s.count.max(1) as f32;
    let finest_m2 = sums.iter().map(disc_m2).fold(f32::INFINITY, f32::min);
    sums.iter().filter(|s| disc_m2(s) <= settings.detail * finest_m2).map(|s| s.part).min()
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
    fn what_a_submap_before_shows_as_well_is_dropped_and_what_is_new_is_kept() {
        let wall = wall(false);
        let parts = [(0.0, 0.005), (0.5, 0.01)].map(|(x, z)| Pose::translation(x, 0.0, z));
        let part = |i: usize| Ok::<_, Infallible>((Cow::Borrowed(&wall), parts[i]));
        let (merged, kept) = merge_each(2, part, &MergeSettings::default()).unwrap();
        assert_eq!(kept, [wall.len(), merged.len() - wall.len()]);
        // The second wall adds its right half.
        assert!((14_800..=15_200).contains(&merged.len()), "{}", merged.len());
        let alone = merge(&[at(&wall, 0.0, 0.005)], &MergeSettings::default());
        assert_eq!(alone.len(), wall.len(), "a submap never drops its own");
        let together = merge(&[at(&wall, 0.0, 0.005), at(&wall, 0.5, 0.01)], &MergeSettings::default());
        assert_eq!(together, merged);
    }

    #[test]
    fn many_submaps_merge_as_few_do() {
        let wall = wall(false);
        let two = [at(&wall, 0.0, 0.005), at(&wall, 0.5, 0.01)];
        let mut many = two.to_vec();
        many.resize(2 * PARTS_AT_ONCE + 3, two[0]);
        assert_eq!(merge(&many, &MergeSettings::default()), merge(&two, &MergeSettings::default()));
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
        assert_eq!(merged, merge(&[at(&solid, 0.0, 0.005)], &MergeSettings::default()));
    }

    #[test]
    fn finer_surfels_replace_coarser_ones_whatever_the_order() {
        let fine = wall(false);
        let mut coarse = wall(false);
        coarse.scale_m.fill([0.02, 0.02]);
        for parts in
            [[at(&fine, 0.0, 0.005), at(&coarse, 0.0, 0.01)], [at(&coarse, 0.0, 0.01), at(&fine, 0.0, 0.005)]]
        {
            let merged = merge(&parts, &MergeSettings::default());
            assert_eq!(merged.len(), fine.len());
            assert!(merged.scale_m.iter().all(|s| s[0] == 0.01));
        }
    }

    #[test]
    fn a_surface_on_the_border_of_two_cubes_is_one_surface() {
        let wall = wall(false);
        let merged = merge(&[at(&wall, 0.0, 0.0195), at(&wall, 0.0, 0.0205)], &MergeSettings::default());
        assert_eq!(merged.len(), wall.len());
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
