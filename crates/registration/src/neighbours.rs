//! Nearest neighbours in three dimensions.

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use nalgebra::Point3;
use std::num::NonZero;

/// A k-d tree over points in metres.
pub struct Neighbours {
    tree: Option<ImmutableKdTree<f32, 3>>,
}

impl Neighbours {
    /// Builds the tree. Points must be finite.
    pub fn new(points: &[Point3<f32>]) -> Self {
        let entries: Vec<[f32; 3]> = points.iter().map(|p| [p.x, p.y, p.z]).collect();
        let tree = if entries.is_empty() { None } else { ImmutableKdTree::new_from_slice(&entries).ok() };
        Neighbours { tree }
    }

    /// The nearest point within `radius_m`: its index and squared distance.
    pub fn nearest(&self, point: &Point3<f32>, radius_m: f32) -> Option<(usize, f32)> {
        let query = [point.x, point.y, point.z];
        let found = self.tree.as_ref()?.query(&query).nearest_one::<SquaredEuclidean<f32>>().execute();
        (found.distance <= radius_m * radius_m).then_some((found.item as usize, found.distance))
    }

    /// Up to `count` nearest points within `radius_m`, nearest first: index and squared distance. A point of
    /// the tree finds itself.
    pub fn within(&self, point: &Point3<f32>, radius_m: f32, count: usize) -> Vec<(usize, f32)> {
        let (Some(tree), Some(count)) = (self.tree.as_ref(), NonZero::new(count)) else {
            return Vec::new();
        };
        let query = [point.x, point.y, point.z];
        let found = tree
            .query(&query)
            .nearest_n::<SquaredEuclidean<f32>>(count)
            .within(radius_m * radius_m)
            .execute();
        found.iter().map(|f| (f.item as usize, f.distance)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbours_lie_within_the_radius_nearest_first() {
        let points: Vec<_> = (0..100).map(|i| Point3::new(i as f32 * 0.1, 0.0, 1.0)).collect();
        let tree = Neighbours::new(&points);
        let found = tree.within(&Point3::new(5.01, 0.0, 1.0), 0.15, 10);
        assert_eq!(found.iter().map(|f| f.0).collect::<Vec<_>>(), vec![50, 51, 49]);
        assert_eq!(tree.nearest(&Point3::new(-0.5, 0.0, 1.0), 0.4), None);
        assert_eq!(Neighbours::new(&[]).nearest(&points[0], 1.0), None);
    }

    #[test]
    fn many_equal_coordinates_are_no_trouble() {
        let points = vec![Point3::new(1.0, 2.0, 3.0); 5000];
        assert_eq!(Neighbours::new(&points).within(&points[0], 0.1, 7).len(), 7);
    }
}
