//! Disjoint sets: what is connected with what.

/// Items, each in one set (union-find; Tarjan 1975).
#[derive(Clone, Debug)]
pub(crate) struct Sets(Vec<usize>);

impl Sets {
    /// `count` items, each alone.
    pub fn new(count: usize) -> Self {
        Sets((0..count).collect())
    }

    /// One item more, alone.
    pub fn push(&mut self) {
        self.0.push(self.0.len());
    }

    /// Makes one set of two.
    pub fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.find(a), self.find(b));
        self.0[a.max(b)] = a.min(b);
    }

    /// The smallest item of the set that holds `k`.
    pub fn find(&mut self, mut k: usize) -> usize {
        while self.0[k] != k {
            self.0[k] = self.0[self.0[k]];
            k = self.0[k];
        }
        k
    }

    /// Whether two are in one set.
    pub fn same(&mut self, a: usize, b: usize) -> bool {
        self.find(a) == self.find(b)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sets_are_named_by_their_smallest_item() {
        let mut sets = Sets::new(5);
        sets.join(3, 4);
        sets.join(4, 1);
        assert_eq!((0..5).map(|k| sets.find(k)).collect::<Vec<_>>(), [0, 1, 2, 1, 1]);
        sets.push();
        assert!(sets.same(1, 3) && !sets.same(5, 0));
    }
}
