//! Rounds in which all blocks move together, on the wire.

use super::names::Team;
use coma_geometry::Tangent;
use coma_geometry::nalgebra::{SMatrix, Vector3};
use coma_pose_graph::blocks::coarse::News;
use coma_pose_graph::blocks::field::{Field, Part};
use coma_pose_graph::blocks::grid::{Grid, MOST_POINTS};
use coma_wire::{At, FieldError, v1};

/// A point of a grid and half of the 26 around it.
const MAX_PAIRS: usize = 14 * MOST_POINTS;

/// A boundary with what it says of the rounds alone.
pub fn written(news: &News, team: &Team) -> v1::Boundary {
    v1::Boundary {
        round: news.round,
        edition: news.edition,
        begun: news.begun,
        root: team.name(news.root),
        depth: news.depth,
        below: news.below,
        edition_heard: news.heard,
        part: news.part.as_ref().map(|part| written_part(part, team)),
        field: news.field.as_ref().map(written_field),
        ..v1::Boundary::default()
    }
}

/// What a boundary says of the rounds.
pub fn read(m: &mut v1::Boundary, team: &Team, at: &At<'_>) -> Result<News, FieldError> {
    Ok(News {
        round: m.round,
        edition: m.edition,
        begun: m.begun,
        root: team.read(std::mem::take(&mut m.root), &at.field("root"))?,
        depth: m.depth,
        below: m.below,
        heard: m.edition_heard,
        part: m.part.take().map(|part| read_part(part, team, &at.field("part"))).transpose()?,
        field: m.field.take().map(|field| read_field(field, &at.field("field"))).transpose()?,
    })
}

fn written_part(part: &Part, team: &Team) -> v1::BlockPart {
    let by_row = |block: &SMatrix<f32, 6, 6>| block.transpose().iter().copied().collect::<Vec<_>>();
    v1::BlockPart {
        agent_ids: part.blocks.iter().map(|block| team.name(*block)).collect(),
        open: part.open.iter().map(|block| team.name(*block)).collect(),
        submaps: part.nodes,
        low_m: part.low.iter().copied().collect(),
        high_m: part.high.iter().copied().collect(),
        largest_squared_error: part.largest_squared,
        points: part.gradient.keys().copied().collect(),
        gradient: part.gradient.values().flat_map(|g| g.iter().copied()).collect(),
        pairs: part.hessian.keys().flat_map(|(a, b)| [*a, *b]).collect(),
        hessian: part.hessian.values().flat_map(by_row).collect(),
    }
}

fn read_part(m: v1::BlockPart, team: &Team, at: &At<'_>) -> Result<Part, FieldError> {
    let mut blocks = team.read_all(m.agent_ids, &at.field("agent_ids"))?;
    let mut open = team.read_all(m.open, &at.field("open"))?;
    blocks.sort_unstable();
    open.sort_unstable();
    let points_at = at.field("points");
    points_at.at_most(m.points.len(), MOST_POINTS, "points")?;
    exactly(m.gradient.len(), 6 * m.points.len(), &at.field("gradient"))?;
    let pairs_at = at.field("pairs");
    pairs_at.at_most(m.pairs.len(), 2 * MAX_PAIRS, "points")?;
    exactly(m.pairs.len(), 2 * (m.pairs.len() / 2), &pairs_at)?;
    exactly(m.hessian.len(), 18 * m.pairs.len(), &at.field("hessian"))?;
    let part = Part {
        blocks,
        open,
        nodes: m.submaps,
        low: vector(&m.low_m, &at.field("low_m"))?,
        high: vector(&m.high_m, &at.field("high_m"))?,
        largest_squared: m.largest_squared_error,
        gradient: m
            .points
            .into_iter()
            .zip(m.gradient.chunks_exact(6).map(Tangent::from_column_slice))
            .collect(),
        hessian: std::iter::zip(m.pairs.chunks_exact(2), m.hessian.chunks_exact(36))
            .map(|(pair, block)| ((pair[0], pair[1]), SMatrix::from_row_slice(block)))
            .collect(),
    };
    match part.is_sound() {
        true => Ok(part),
        false => Err(at.refuse("a number is not finite or over 1e30, or a pair of points is not in order")),
    }
}

fn written_field(field: &Field) -> v1::BlockField {
    let next = &field.next;
    v1::BlockField {
        motions: field.motions.iter().flat_map(|m| m.iter().copied()).collect(),
        largest_squared_error: field.largest_squared,
        next: Some(v1::BlockGrid {
            origin_m: next.origin.iter().copied().collect(),
            spacing_m: next.spacing_m,
            points: next.points.to_vec(),
        }),
    }
}

fn read_field(m: v1::BlockField, at: &At<'_>) -> Result<Field, FieldError> {
    let motions_at = at.field("motions");
    motions_at.at_most(m.motions.len(), 6 * MOST_POINTS, "numbers")?;
    exactly(m.motions.len(), 6 * (m.motions.len() / 6), &motions_at)?;
    let next_at = at.field("next");
    let next: v1::BlockGrid = m.next.ok_or_else(|| next_at.refuse("is missing"))?;
    let points_at = next_at.field("points");
    let points = <[u32; 3]>::try_from(next.points)
        .map_err(|points| points_at.refuse(format!("{} numbers, 3 are needed", points.len())))?;
    let field = Field {
        motions: m.motions.chunks_exact(6).map(Tangent::from_column_slice).collect(),
        largest_squared: m.largest_squared_error,
        next: Grid {
            origin: vector(&next.origin_m, &next_at.field("origin_m"))?,
            spacing_m: next.spacing_m,
            points,
        },
    };
    match field.is_sound() {
        true => Ok(field),
        false => Err(at.refuse(format!("a number is not finite or over 1e30, or over {MOST_POINTS} points"))),
    }
}

fn vector(numbers: &[f64], at: &At<'_>) -> Result<Vector3<f64>, FieldError> {
    exactly(numbers.len(), 3, at)?;
    Ok(Vector3::from_column_slice(numbers))
}

fn exactly(found: usize, needed: usize, at: &At<'_>) -> Result<(), FieldError> {
    match found == needed {
        true => Ok(()),
        false => Err(at.refuse(format!("{found} numbers, {needed} are needed"))),
    }
}
