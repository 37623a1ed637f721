//! Pairwise consistency maximisation (Mangelson et al., ICRA 2018): of all loops between two chains, the largest
//! set in which every two agree with each other through the odometry between their ends.

use crate::chain::Trunk;
use crate::clique::{Adjacency, Clique, CliqueSettings, largest};
use crate::graph::Edge;
use crate::uncertain::UncertainPose;
use coma_geometry::SubmapId;

/// A loop between chains s and t, turned so that it goes from s to t.
#[derive(Clone, Debug, PartialEq)]
pub struct Bridge {
    /// End in s.
    pub in_s: SubmapId,
    /// End in t.
    pub in_t: SubmapId,
    /// Measured `i_from_j` with its covariance.
    pub i_from_j: UncertainPose,
}

impl Bridge {
    /// Turns a loop so that it starts in s. `None` if its information has no inverse.
    pub fn new(edge: &Edge, from_is_in_s: bool) -> Option<Self> {
        let measured = UncertainPose::from_information(edge.from_from_to, &edge.information)?;
        Some(if from_is_in_s {
            Bridge { in_s: edge.from.clone(), in_t: edge.to.clone(), i_from_j: measured }
        } else {
            Bridge { in_s: edge.to.clone(), in_t: edge.from.clone(), i_from_j: measured.inverse() }
        })
    }
}

/// Squared Mahalanobis error of the cycle i -> j -> l -> k -> i over two bridges (i, j), (k, l) and both trunks:
/// chi-square with 6 degrees of freedom if both are true. Infinite where an end is unknown.
pub fn cycle_error(a: &Bridge, b: &Bridge, s: &Trunk, t: &Trunk) -> f64 {
    let (Some(j_from_l), Some(k_from_i)) = (t.between(&a.in_t, &b.in_t), s.between(&b.in_s, &a.in_s)) else {
        return f64::INFINITY;
    };
    let i_from_l = a.i_from_j.compose(&j_from_l);
    let i_from_k = i_from_l.compose(&b.i_from_j.inverse());
    i_from_k.compose(&k_from_i).squared_distance_from_identity()
}

/// The largest set of bridges that agree pairwise; `limit` is the largest squared error of a cycle.
pub fn largest_consistent_set(
    bridges: &[Bridge],
    s: &Trunk,
    t: &Trunk,
    limit: f64,
    settings: &CliqueSettings,
) -> Clique {
    let mut agree = Adjacency::new(bridges.len());
    for a in 0..bridges.len() {
        for b in 0..a {
            if cycle_error(&bridges[a], &bridges[b], s, t) <= limit {
                agree.join(a, b);
            }
        }
    }
    largest(&agree, settings)
}

/// Two loops of one chain test each other if odometry needs at most this many steps from ends to ends: farther apart
/// its drift lets nearly everything agree.
pub const STEPS_THAT_TEST: usize = 30;

/// Which loops within a chain no other one supports, where most have support: `lonely[loop]`. A loop is supported if
/// another one close by agrees with it. Where loops are too sparse to test each other none is lonely.
pub fn lonely(loops: &[&Edge], trunk: &Trunk, limit: f64) -> Vec<bool> {
    let mut bridges: Vec<(usize, usize, Bridge)> = Vec::new();
    for (k, edge) in loops.iter().enumerate() {
        let depths = trunk.depth(&edge.from).zip(trunk.depth(&edge.to));
        if let Some((from, to)) = depths
            && let Some(bridge) = Bridge::new(edge, from <= to)
        {
            bridges.push((from.min(to), k, bridge));
        }
    }
    bridges.sort_by_key(|(depth, k, _)| (*depth, *k));
    let mut supported = vec![false; loops.len()];
    for (n, (depth, k, a)) in bridges.iter().enumerate() {
        for (_, other, b) in bridges[n + 1..].iter().take_while(|(d, _, _)| d - depth <= STEPS_THAT_TEST) {
            let steps = |x, y| trunk.steps_between(x, y).unwrap_or(usize::MAX / 2);
            let tested = steps(&a.in_s, &b.in_s) + steps(&a.in_t, &b.in_t) <= STEPS_THAT_TEST;
            if tested && !(supported[*k] && supported[*other]) && cycle_error(a, b, trunk, trunk) <= limit {
                supported[*k] = true;
                supported[*other] = true;
            }
        }
    }
    let enough = 2 * supported.iter().filter(|s| **s).count() >= loops.len();
    supported.iter().map(|s| enough && !s).collect()
}
