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
    let keepers = match Keepers::in_rounds(1, parts.len(), part, settings) {
        Ok(keepers) => keepers,
        Err(never) => match never {},
    };
    let kept = parts.iter().enumerate().flat_map(|(i, p)| keepers.kept(i, p.surfels, &p.map_from_submap));
    kept.collect()
}

/// What [`merge`] keeps of each submap, for submaps that need not be in memory together.
pub struct Keepers {
    /// The submap that keeps its surfels in a cube, sorted by cube; `None` if all do.
    of_cell: Vec<(Cell, Option<u32>)>,
    counts: Vec<usize>,
    cell_m: f64,
}

impl Keepers {
    /// Among `count` submaps: `part` is asked for each, in order, for its surfels and `map_from_submap`; once for every
    /// 64 submaps.
    pub fn among<'a, E>(
        count: usize,
        part: impl FnMut(usize) -> Result<(Cow<'a, SurfelCloud>, Pose), E>,
        settings: &MergeSettings,
    ) -> Result<Self, E> {
        Self::in_rounds(count.div_ceil(PARTS_AT_ONCE), count, part, settings)
    }

    fn in_rounds<'a, E>(
        rounds: usize,
        count: usize,
        mut part: impl FnMut(usize) -> Result<(Cow<'a, SurfelCloud>, Pose), E>,
        settings: &MergeSettings,
    ) -> Result<Self, E> {
        let face_m2 = (settings.cell_m * settings.cell_m) as f32;
        let mut out = Keepers { of_cell: Vec::new(), counts: vec![0; count], cell_m: settings.cell_m };
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
            out.add(shares, face_m2, settings);
        }
        out.of_cell.sort_unstable_by_key(|(cell, _)| *cell);
        Ok(out)
    }

    fn add(&mut self, mut shares: Vec<(Cell, Share)>, face_m2: f32, settings: &MergeSettings) {
        shares.sort_unstable_by_key(|(cell, share)| (*cell, share.part));
        for of_cell in shares.chunk_by(|a, b| a.0 == b.0) {
            let cell = of_cell[0].0;
            let keeper = keeper(&shares, cell, face_m2, settings);
            for (_, share) in of_cell.iter().filter(|(_, s)| keeper.is_none_or(|keeper| keeper == s.part)) {
                self.counts[share.part as usize] += share.count as usize;
            }
            self.of_cell.push((cell, keeper));
        }
    }

    /// How many surfels of each submap are kept.
    pub fn counts(&self) -> &[usize] {
        &self.counts
    }

    /// What is kept of a submap, in the map, in its order. `surfels` and `map_from_submap` must be those that
    /// [`Keepers::among`] got for it.
    pub fn kept<'a>(
        &'a self,
        part: usize,
        surfels: &'a SurfelCloud,
        map_from_submap: &'a Pose,
    ) -> impl Iterator<Item = Surfel> + 'a {
        placed(surfels, map_from_submap).filter(move |surfel| {
            let cell = cell(surfel, self.cell_m);
            let found = self.of_cell.binary_search_by_key(&cell, |(cell, _)| *cell);
            found.ok().and_then(|at| self.of_cell[at].1).is_none_or(|keeper| keeper as usize == part)
        })
    }
}

/// Surfels in the map.
fn placed<'a>(surfels: &'a SurfelCloud, map_from_submap: &'a Pose) -> impl Iterator<Item = Surfel> + 'a {
    surfels.iter().map(|surfel| surfel.moved(map_from_submap)).filter(Surfel::is_finite)
}

/// A number that cubes before and behind a surface have in common: what decides on them lies together.
fn column((cube, side): &Cell) -> usize {
    let axis = *side as usize / 2;
    let across = [cube[(axis + 1) % 3], cube[(axis + 2) % 3]].map(|v| v as u32);
    (across[0].wrapping_mul(73_856_093) ^ across[1].wrapping_mul(19_349_663)) as usize
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
        let merged = merge(&[at(&wall, 0.0, 0.005), at(&wall, 0.5, 0.01)], &MergeSettings::default());
        // The second wall adds its right half.
        assert!((14_800..=15_200).contains(&merged.len()), "{}", merged.len());
        let alone = merge(&[at(&wall, 0.0, 0.005)], &MergeSettings::default());
        assert_eq!(alone.len(), wall.len(), "a submap never drops its own");
    }

    #[test]
    fn submaps_one_after_the_other_merge_as_they_do_together() {
        let wall = wall(false);
        let mut parts = vec![at(&wall, 0.0, 0.005), at(&wall, 0.5, 0.01)];
        parts.resize(2 * PARTS_AT_ONCE + 3, parts[0]);
        let part = |i: usize| Ok::<_, Infallible>((Cow::Borrowed(&wall), parts[i].map_from_submap));
        let keepers = Keepers::among(parts.len(), part, &MergeSettings::default()).unwrap();
        let kept = |i: usize| -> SurfelCloud { keepers.kept(i, &wall, &parts[i].map_from_submap).collect() };
        for i in 0..parts.len() {
            assert_eq!(kept(i).len(), keepers.counts()[i], "{i}");
        }
        let together = merge(&parts, &MergeSettings::default());
        assert_eq!(
            (0..parts.len()).flat_map(|i| kept(i).iter().collect::<Vec<_>>()).collect::<SurfelCloud>(),
            together
        );
        assert_eq!(together, merge(&parts[..2], &MergeSettings::default()));
        assert_eq!(keepers.counts()[..2], [wall.len(), together.len() - wall.len()]);
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
