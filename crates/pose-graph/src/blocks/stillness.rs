//! How blocks that never wait for one another come to know that all of them are still.
//!
//! Each block says whether it is still, and counts how often that has changed; what it knows of all goes round with the
//! boundaries. A block that sees all of them still confirms the counts that it sees. When all have confirmed the same
//! counts there was a moment at which all were still: that at which the last of these counts was reached. A block is
//! still only when all its neighbours have heard where it is, so that at that moment no news was on its way either.

use super::BlockId;

/// What a block says of itself.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Standing {
    /// Whose.
    pub block: BlockId,
    /// Rises with whatever it says; larger is newer.
    pub edition: u64,
    /// How often it has become still, or no longer.
    pub changes: u64,
    /// It is still.
    pub still: bool,
    /// Names the changes of all that it has confirmed; 0 for none.
    pub confirmed: u64,
}

/// What one block knows of all.
#[derive(Clone, Debug)]
pub struct Stillness {
    own: BlockId,
    table: Vec<Standing>,
    version: u64,
}

impl Stillness {
    /// Nobody is still yet.
    pub fn new(own: BlockId, blocks: usize) -> Self {
        let table = (0..blocks).map(|k| Standing { block: k as BlockId, ..Standing::default() }).collect();
        Stillness { own, table, version: 0 }
    }

    /// Changes whenever there is something new to tell.
    pub fn version(&self) -> u64 {
        self.version
    }

    /// What there is to tell: of those that were ever still.
    pub fn told(&self) -> impl Iterator<Item = &Standing> {
        self.table.iter().filter(|s| s.edition > 0)
    }

    /// Takes what a block said of itself, from whoever tells it. What is older changes nothing.
    pub fn take(&mut self, said: &Standing) {
        if said.block == self.own {
            return;
        }
        let Some(known) = self.table.get_mut(said.block as usize) else { return };
        if said.edition > known.edition {
            *known = *said;
            self.version += 1;
        }
        self.confirm();
    }

    /// Says whether the own block is still. To be said after every change: one that moved and is still again has moved.
    pub fn say(&mut self, still: bool) {
        let Some(own) = self.table.get_mut(self.own as usize) else { return };
        if own.still != still {
            *own =
                Standing { edition: own.edition + 1, changes: own.changes + 1, still, confirmed: 0, ..*own };
            self.version += 1;
        }
        self.confirm();
    }

    /// True if all blocks are still as far as this one knows: the end may be near.
    pub fn seems_over(&self) -> bool {
        self.name().is_some()
    }

    /// True if all blocks were still at one moment.
    pub fn all_still(&self) -> bool {
        self.name().is_some_and(|name| self.table.iter().all(|s| s.confirmed == name))
    }

    /// What all must confirm: the name of their changes, if all are still.
    fn name(&self) -> Option<u64> {
        if !self.table.iter().all(|s| s.still) {
            return None;
        }
        let mut hasher = blake3::Hasher::new();
        for standing in &self.table {
            hasher.update(&standing.changes.to_le_bytes());
        }
        let first: [u8; 8] = hasher.finalize().as_bytes()[..8].try_into().unwrap_or_default();
        Some(u64::from_le_bytes(first).max(1))
    }

    fn confirm(&mut self) {
        let Some(name) = self.name() else { return };
        let Some(own) = self.table.get_mut(self.own as usize) else { return };
        if own.confirmed != name {
            *own = Standing { edition: own.edition + 1, confirmed: name, ..*own };
            self.version += 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tell(from: &Stillness, to: &mut Stillness) {
        let told: Vec<Standing> = from.told().copied().collect();
        told.iter().for_each(|s| to.take(s));
    }

    /// Everybody tells everybody, in a row, until nothing changes.
    fn spread(all: &mut [Stillness]) {
        for _ in 0..100 {
            let before: u64 = all.iter().map(Stillness::version).sum();
            for k in 1..all.len() {
                let (left, right) = all.split_at_mut(k);
                tell(&left[k - 1], &mut right[0]);
                tell(&right[0], &mut left[k - 1]);
            }
            if all.iter().map(Stillness::version).sum::<u64>() == before {
                return;
            }
        }
        panic!("they never agree");
    }

    #[test]
    fn all_are_still_when_each_has_confirmed_what_it_has_seen_of_all() {
        let mut all: Vec<Stillness> = (0..5).map(|k| Stillness::new(k, 5)).collect();
        for k in 0..4 {
            all[k].say(true);
        }
        spread(&mut all);
        assert!(all.iter().all(|s| !s.all_still()));
        all[4].say(true);
        assert!(!all[4].all_still(), "it has not heard that the others have seen it");
        spread(&mut all);
        assert!(all.iter().all(Stillness::all_still));
    }

    #[test]
    fn one_that_moved_meanwhile_undoes_it() {
        let mut all: Vec<Stillness> = (0..3).map(|k| Stillness::new(k, 3)).collect();
        all.iter_mut().for_each(|s| s.say(true));
        // The middle one knows that all are still; then the first one hears of an old move of its own and goes on.
        let (first, last) = (all[0].clone(), all[2].clone());
        tell(&first, &mut all[1]);
        tell(&last, &mut all[1]);
        all[0].say(false);
        all[0].say(true);
        let middle = all[1].clone();
        tell(&middle, &mut all[0]);
        tell(&middle, &mut all[2]);
        assert!(all.iter().all(|s| !s.all_still()), "they have confirmed different counts");
        spread(&mut all);
        assert!(all.iter().all(Stillness::all_still));
    }

    #[test]
    fn strangers_and_what_is_said_of_oneself_change_nothing() {
        let mut one = Stillness::new(0, 2);
        one.take(&Standing { block: 9, edition: 7, changes: 7, still: true, confirmed: 3 });
        one.take(&Standing { block: 0, edition: 7, changes: 7, still: true, confirmed: 3 });
        assert_eq!((one.version(), one.told().count()), (0, 0));
    }
}
