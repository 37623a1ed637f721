//! Rounds in which all blocks move together, by a [`Field`].
//!
//! Who has the smallest number sums up: blocks make a tree of shortest ways to it, each adds to its own part those of the
//! blocks below it, and once the sum is whole the field goes down the same ways. Who is told the field moves, and goes to
//! the next round. Nobody waits: descent goes on meanwhile, and where the parts never come together it goes on alone.
//! All that is said is a state under a number, so that loss, delay, repetition and disorder cost time alone.

use super::BlockId;
use super::field::{Field, Part};
use super::grid::Grid;
use coma_geometry::Pose;
use std::collections::BTreeMap;

/// What was not acknowledged is said again after so many steps.
const REPEAT: u32 = 4;

/// What a block tells a neighbour of the rounds.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct News {
    /// Rounds that have moved the block.
    pub round: u64,
    /// Rises with whatever it says of them.
    pub edition: u64,
    /// It has said its part in the next one.
    pub begun: bool,
    /// The smallest number that it has heard of,
    pub root: BlockId,
    /// and over how many blocks it is there.
    pub depth: u32,
    /// The reader is the next one on that way.
    pub below: bool,
    /// Edition of the reader's part that it has taken; 0 for none.
    pub heard: u64,
    /// Its own part in the next round with those of all below it.
    pub part: Option<Part>,
    /// What led to its round.
    pub field: Option<Field>,
}

impl News {
    /// Size as plain numbers.
    pub fn bytes(&self) -> usize {
        let part = self.part.as_ref().map_or(0, Part::bytes);
        8 + 8 + 1 + 4 + 4 + 1 + 8 + 1 + part + 1 + self.field.as_ref().map_or(0, Field::bytes)
    }
}

/// A neighbour, as it was last heard.
#[derive(Clone, Debug, Default)]
struct Peer {
    /// Its round and edition.
    at: (u64, u64),
    begun: bool,
    below: bool,
    /// Edition of ours that it has taken.
    heard: u64,
    /// Its part in our next round, and that part's edition.
    part: Option<(u64, Part)>,
    /// Our round and edition when it was last told of them, and the steps since.
    told: (u64, u64),
    since: u32,
}

/// Rounds as one block sees them.
pub(super) struct Coarse {
    /// Rounds that have moved this block.
    pub round: u64,
    edition: u64,
    most_points: usize,
    root: BlockId,
    depth: u32,
    /// The next one on the way to the root.
    parent: Option<BlockId>,
    peers: BTreeMap<BlockId, Peer>,
    /// Of the next round.
    grid: Grid,
    own: Option<Part>,
    /// With those of all below, and the edition that it came with.
    sum: Option<(u64, Part)>,
    /// What led to this round, over the grid that it had.
    last: Option<(Grid, Field)>,
}

impl Coarse {
    /// Before the first round.
    pub fn new(own: BlockId, neighbours: impl Iterator<Item = BlockId>, most_points: usize) -> Self {
        Coarse {
            round: 0,
            edition: 1,
            most_points,
            root: own,
            depth: 0,
            parent: None,
            peers: neighbours.map(|id| (id, Peer::default())).collect(),
            grid: Grid::default(),
            own: None,
            sum: None,
            last: None,
        }
    }

    /// The grid of the next round.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// True if this block has said its part in the next round.
    pub fn has_said(&self) -> bool {
        self.own.is_some()
    }

    /// True if this block or a neighbour has.
    pub fn has_begun(&self) -> bool {
        self.has_said() || self.peers.values().any(|p| p.begun && p.at.0 == self.round)
    }

    /// Says this block's own part in the next round.
    pub fn say(&mut self, part: Part) {
        self.own = Some(part);
        self.edition += 1;
    }

    /// Takes what a neighbour tells. True if that moves this block.
    pub fn take(&mut self, from: BlockId, news: &News) -> bool {
        let Some(peer) = self.peers.get_mut(&from) else { return false };
        if peer.at <= (news.round, news.edition) {
            peer.at = (news.round, news.edition);
            (peer.begun, peer.heard) = (news.begun, news.heard);
            if peer.below != news.below {
                peer.below = news.below;
                self.sum = None;
            }
            if !news.below && peer.part.take().is_some() {
                self.sum = None;
            }
            if (news.root, news.depth.saturating_add(1)) < (self.root, self.depth) {
                (self.root, self.depth, self.parent) = (news.root, news.depth.saturating_add(1), Some(from));
                self.edition += 1;
            }
        }
        let newer = peer.part.as_ref().is_none_or(|(edition, _)| *edition < news.edition);
        if let Some(part) = news.part.as_ref().filter(|p| p.is_sound())
            && peer.below
            && newer
            && news.round == self.round
        {
            peer.part = Some((news.edition, part.clone()));
            self.sum = None;
        }
        match &news.field {
            Some(field)
                if news.round == self.round + 1
                    && field.motions.len() == self.grid.len()
                    && field.is_sound() =>
            {
                self.follow(field.clone());
                true
            }
            _ => false,
        }
    }

    /// Sums up what is there. True if that is the whole, and moves this block.
    pub fn collect(&mut self) -> bool {
        let below = || self.peers.values().filter(|p| p.below);
        let (Some(own), None) = (&self.own, &self.sum) else { return false };
        if !below().all(|p| p.part.is_some()) {
            return false;
        }
        let Some(sum) = own.sum(below().filter_map(|p| Some(&p.part.as_ref()?.1))) else { return false };
        if self.parent.is_none() && sum.open.is_empty() {
            self.follow(sum.field(&self.grid, self.most_points));
            return true;
        }
        self.edition += 1;
        self.sum = Some((self.edition, sum));
        false
    }

    /// What a neighbour is to be told, and whether that alone is worth a message; what it has not acknowledged is said
    /// `again` from time to time.
    pub fn tell(&mut self, to: BlockId, again: bool) -> (News, bool) {
        let mut news = News {
            round: self.round,
            edition: self.edition,
            begun: self.own.is_some(),
            root: self.root,
            depth: self.depth,
            below: self.parent == Some(to),
            ..News::default()
        };
        let Some(peer) = self.peers.get_mut(&to) else { return (news, false) };
        news.heard = peer.part.as_ref().map_or(0, |(edition, _)| *edition);
        peer.since = peer.since.saturating_add(1);
        let left_behind = peer.below && peer.at.0 < self.round;
        // One that is left behind takes no poses until it has followed: it is told for as long as it takes.
        let waits = peer.since >= REPEAT && (left_behind || news.begun && again);
        let due = peer.told != (self.round, self.edition) || waits;
        if due {
            peer.told = (self.round, self.edition);
            peer.since = 0;
            if left_behind {
                news.field = self.last.as_ref().map(|(_, field)| field.clone());
            }
            let lacking = self.sum.as_ref().filter(|(edition, _)| news.below && peer.heard < *edition);
            news.part = lacking.map(|(_, part)| part.clone());
        }
        (news, due)
    }

    fn follow(&mut self, field: Field) {
        self.last = Some((self.grid, field.clone()));
        self.grid = field.next;
        self.round += 1;
        self.edition += 1;
        (self.own, self.sum) = (None, None);
        self.peers.values_mut().for_each(|p| p.part = None);
    }

    /// Where the newest round has moved a pose to.
    pub fn moved(&self, pose: &Pose) -> Pose {
        self.last.as_ref().map_or(*pose, |(grid, field)| grid.moved(&field.motions, pose))
    }

    /// Largest squared error of a doubted measurement, of all blocks, before the newest round.
    pub fn largest_squared(&self) -> f64 {
        self.last.as_ref().map_or(0.0, |(_, field)| field.largest_squared)
    }
}
