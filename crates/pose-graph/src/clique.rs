//! The largest set of nodes of a graph that are all joined with each other.

use serde::{Deserialize, Serialize};

/// An undirected graph as bit rows.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Adjacency {
    nodes: usize,
    rows: Vec<Vec<u64>>,
}

impl Adjacency {
    /// No edges.
    pub fn new(nodes: usize) -> Self {
        Adjacency { nodes, rows: vec![vec![0; nodes.div_ceil(64)]; nodes] }
    }

    /// Joins two different nodes.
    pub fn join(&mut self, a: usize, b: usize) {
        if a != b {
            self.rows[a][b / 64] |= 1 << (b % 64);
            self.rows[b][a / 64] |= 1 << (a % 64);
        }
    }

    /// Are they joined?
    pub fn joined(&self, a: usize, b: usize) -> bool {
        self.rows[a][b / 64] >> (b % 64) & 1 == 1
    }

    /// Number of neighbours.
    pub fn degree(&self, node: usize) -> usize {
        self.rows[node].iter().map(|w| w.count_ones() as usize).sum()
    }
}

/// How long to search.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CliqueSettings {
    /// Above this many nodes only the greedy heuristic runs.
    pub exact_up_to: usize,
    /// Branches that the exact search may take before it returns the best found.
    pub max_branches: u64,
}

impl Default for CliqueSettings {
    fn default() -> Self {
        CliqueSettings { exact_up_to: 300, max_branches: 200_000 }
    }
}

/// A set of nodes, all joined with each other.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Clique {
    /// Ascending.
    pub members: Vec<usize>,
    /// True if no larger one exists.
    pub exact: bool,
}

/// The largest clique, or a large one where the search limits forbid to be sure. Deterministic.
pub fn largest(graph: &Adjacency, settings: &CliqueSettings) -> Clique {
    let mut best = greedy(graph);
    let mut exact = false;
    if graph.nodes <= settings.exact_up_to {
        let mut search = Search {
            graph,
            best: best.clone(),
            current: Vec::new(),
            left: settings.max_branches,
            cut_short: false,
        };
        let mut candidates: Vec<usize> = (0..graph.nodes).collect();
        candidates.sort_by_key(|&n| (std::cmp::Reverse(graph.degree(n)), n));
        search.expand(&candidates);
        exact = !search.cut_short;
        best = search.best;
    }
    best.sort_unstable();
    Clique { members: best, exact }
}

/// From each node in turn, always adds the candidate of the highest degree (Pattabiraman et al. 2015).
fn greedy(graph: &Adjacency) -> Vec<usize> {
    let degree: Vec<usize> = (0..graph.nodes).map(|n| graph.degree(n)).collect();
    let mut order: Vec<usize> = (0..graph.nodes).collect();
    order.sort_by_key(|&n| (std::cmp::Reverse(degree[n]), n));
    let mut best = Vec::new();
    for &seed in &order {
        if degree[seed] < best.len() {
            break;
        }
        let mut members = vec![seed];
        for &next in &order {
            if next != seed && members.iter().all(|&m| graph.joined(m, next)) {
                members.push(next);
            }
        }
        if members.len() > best.len() {
            best = members;
        }
    }
    best
}

/// Branch and bound with a colouring bound (Tomita and Seki 2003).
struct Search<'a> {
    graph: &'a Adjacency,
    best: Vec<usize>,
    current: Vec<usize>,
    left: u64,
    cut_short: bool,
}

impl Search<'_> {
    fn expand(&mut self, candidates: &[usize]) {
        let (order, colours) = self.colour(candidates);
        let mut remaining = order.clone();
        for k in (0..order.len()).rev() {
            if self.current.len() + colours[k] <= self.best.len() {
                return;
            }
            if self.left == 0 {
                self.cut_short = true;
                return;
            }
            self.left -= 1;
            let node = order[k];
            remaining.truncate(k);
            self.current.push(node);
            let next: Vec<usize> =
                remaining.iter().copied().filter(|&n| self.graph.joined(node, n)).collect();
            if next.is_empty() {
                if self.current.len() > self.best.len() {
                    self.best = self.current.clone();
                }
            } else {
                self.expand(&next);
            }
            self.current.pop();
        }
    }

    /// Nodes by colour class, with the number of classes up to each: a bound on a clique among them.
    fn colour(&self, candidates: &[usize]) -> (Vec<usize>, Vec<usize>) {
        let mut classes: Vec<Vec<usize>> = Vec::new();
        for &node in candidates {
            let free = classes.iter().position(|class| class.iter().all(|&m| !self.graph.joined(m, node)));
            match free {
                Some(class) => classes[class].push(node),
                None => classes.push(vec![node]),
            }
        }
        let colours = classes.iter().enumerate().flat_map(|(c, class)| class.iter().map(move |_| c + 1));
        let colours = colours.collect();
        (classes.into_iter().flatten().collect(), colours)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn random_graph(nodes: usize, percent: u64, seed: u64) -> Adjacency {
        let mut state = seed;
        let mut graph = Adjacency::new(nodes);
        for a in 0..nodes {
            for b in 0..a {
                state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                if (state >> 33) % 100 < percent {
                    graph.join(a, b);
                }
            }
        }
        graph
    }

    fn is_clique(graph: &Adjacency, members: &[usize]) -> bool {
        members.iter().all(|&a| members.iter().all(|&b| a == b || graph.joined(a, b)))
    }

    #[test]
    fn the_exact_search_agrees_with_trying_every_set() {
        for seed in 0..40 {
            let graph = random_graph(12, 30 + seed, seed + 1);
            let largest_by_force = (0u32..1 << 12)
                .filter(|set| {
                    let members: Vec<usize> = (0..12).filter(|k| set >> k & 1 == 1).collect();
                    is_clique(&graph, &members)
                })
                .map(|set| set.count_ones() as usize)
                .max()
                .unwrap();
            let found = largest(&graph, &CliqueSettings::default());
            assert!(found.exact && is_clique(&graph, &found.members));
            assert_eq!(found.members.len(), largest_by_force, "seed {seed}");
        }
    }

    #[test]
    fn the_greedy_search_finds_a_planted_clique() {
        let mut graph = random_graph(400, 10, 3);
        let planted: Vec<usize> = (0..30).map(|k| k * 13).collect();
        for &a in &planted {
            for &b in &planted {
                graph.join(a, b);
            }
        }
        let found = largest(&graph, &CliqueSettings::default());
        assert!(!found.exact && is_clique(&graph, &found.members));
        assert!(found.members.len() >= 30);
    }

    #[test]
    fn a_search_that_runs_out_says_so() {
        let graph = random_graph(120, 80, 5);
        let found = largest(&graph, &CliqueSettings { max_branches: 10, ..CliqueSettings::default() });
        assert!(!found.exact && is_clique(&graph, &found.members));
        assert!(largest(&Adjacency::new(0), &CliqueSettings::default()).members.is_empty());
    }
}
