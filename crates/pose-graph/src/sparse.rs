//! A symmetric positive definite matrix of `B`x`B` blocks and its Cholesky factor.
//!
//! The graph of blocks is ordered once (approximate minimum degree), expanded by `B`, and factorised
//! symbolically once; afterwards values are scattered straight into place. Supernodes are forced: blocks
//! of six make them pay. Everything runs on one thread, so sums have one order.

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt::factor::{LltError, LltRegularization};
use faer::sparse::linalg::amd;
use faer::sparse::linalg::cholesky::{
    CholeskySymbolicParams, SymbolicCholesky, SymbolicCholeskyRaw, SymmetricOrdering,
    factorize_symbolic_cholesky, supernodal,
};
use faer::sparse::{FaerError, SparseColMatRef, SymbolicSparseColMatRef};
use faer::{Conj, MatMut, Par, Side};
use nalgebra::SMatrix;

/// Why a factorisation failed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SparseError {
    /// The matrix is not positive definite at this block.
    #[error("the system is not positive definite at block {block}: that variable is not constrained")]
    NotPositiveDefinite {
        /// The variable.
        block: usize,
    },
    /// The matrix is larger than memory or indices allow.
    #[error("the system of {blocks} blocks is too large: {reason}")]
    TooLarge {
        /// Number of block rows.
        blocks: usize,
        /// What ran out.
        reason: String,
    },
}

/// Where a block of the matrix lies among the stored values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Slot {
    /// Ordered block column.
    column: usize,
    /// 0 for the diagonal block, then 1, 2, ... downwards.
    rank: usize,
    /// The stored block is the transpose of the one that the caller means.
    transposed: bool,
}

/// A handle to the block `(row, column)`, for scattering values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BlockSlot(Slot);

/// The matrix, its pattern and its factor.
pub struct BlockCholesky<const B: usize> {
    blocks: usize,
    /// `position[block]`: its place in the elimination order.
    position: Vec<usize>,
    /// `block_at[place]`: inverse of `position`.
    block_at: Vec<usize>,
    /// Ordered block pattern of the lower triangle: rows below the diagonal, by column, ascending.
    below: Vec<Vec<usize>>,
    col_ptr: Vec<usize>,
    row_idx: Vec<usize>,
    values: Vec<f64>,
    symbolic: SymbolicCholesky<usize>,
    factor: Vec<f64>,
    scratch: MemBuffer,
    rhs: Vec<f64>,
}

impl<const B: usize> BlockCholesky<B> {
    /// Orders and analyses a matrix of `blocks` x `blocks` blocks whose off-diagonal blocks are at `pairs`
    /// (unordered; duplicates are fine). The diagonal is always present.
    pub fn new(blocks: usize, pairs: &[(usize, usize)]) -> Result<Self, SparseError> {
        let too_large = |e: FaerError| SparseError::TooLarge { blocks, reason: e.to_string() };
        let (block_at, position) = minimum_degree(blocks, pairs).map_err(too_large)?;
        let mut below = vec![Vec::new(); blocks];
        for &(a, b) in pairs {
            if a != b {
                let (p, q) = (position[a], position[b]);
                below[p.min(q)].push(p.max(q));
            }
        }
        for rows in &mut below {
            rows.sort_unstable();
            rows.dedup();
        }
        let (col_ptr, row_idx) = expand_lower::<B>(&below);
        let symbolic = {
            // The analysis reads the upper triangle.
            let (ptr, idx) = transpose(blocks * B, &col_ptr, &row_idx);
            factorize_symbolic_cholesky(
                SymbolicSparseColMatRef::new_checked(blocks * B, blocks * B, &ptr, None, &idx),
                Side::Upper,
                SymmetricOrdering::Identity,
                CholeskySymbolicParams {
                    supernodal_flop_ratio_threshold:
                        faer::sparse::linalg::SupernodalThreshold::FORCE_SUPERNODAL,
                    ..Default::default()
                },
            )
            .map_err(too_large)?
        };
        let scratch = symbolic
            .factorize_numeric_llt_scratch::<f64>(Par::Seq, Default::default())
            .or(symbolic.solve_in_place_scratch::<f64>(B, Par::Seq));
        let scratch = MemBuffer::try_new(scratch).map_err(|_| too_large(FaerError::OutOfMemory))?;
        Ok(BlockCholesky {
            blocks,
            values: vec![0.0; row_idx.len()],
            factor: vec![0.0; symbolic.len_val()],
            rhs: vec![0.0; blocks * B * B],
            position,
            block_at,
            below,
            col_ptr,
            row_idx,
            symbolic,
            scratch,
        })
    }

    /// Number of block rows.
    pub fn blocks(&self) -> usize {
        self.blocks
    }

    /// Where block `(row, column)` is stored. `None` if the pattern does not hold it.
    pub fn slot(&self, row: usize, column: usize) -> Option<BlockSlot> {
        let (p, q) = (*self.position.get(row)?, *self.position.get(column)?);
        if p == q {
            return Some(BlockSlot(Slot { column: p, rank: 0, transposed: false }));
        }
        let (top, bottom) = (p.min(q), p.max(q));
        let rank = 1 + self.below[top].binary_search(&bottom).ok()?;
        // Stored is the lower triangle: block (bottom, top).
        Some(BlockSlot(Slot { column: top, rank, transposed: p < q }))
    }

    /// Sets every value to zero.
    pub fn clear(&mut self) {
        self.values.fill(0.0);
    }

    /// Adds a block. Of a diagonal block only the lower triangle is read.
    pub fn add(&mut self, slot: BlockSlot, block: &SMatrix<f64, B, B>) {
        let Slot { column, rank, transposed } = slot.0;
        for b in 0..B {
            let start = self.col_ptr[column * B + b];
            if rank == 0 {
                for a in b..B {
                    self.values[start + a - b] += block[(a, b)];
                }
            } else {
                let start = start + (B - b) + (rank - 1) * B;
                for a in 0..B {
                    self.values[start + a] += if transposed { block[(b, a)] } else { block[(a, b)] };
                }
            }
        }
    }

    /// The diagonal of the matrix, by block.
    pub fn diagonal(&self) -> Vec<f64> {
        let mut out = vec![0.0; self.blocks * B];
        for (place, &block) in self.block_at.iter().enumerate() {
            for k in 0..B {
                out[block * B + k] = self.values[self.col_ptr[place * B + k]];
            }
        }
        out
    }

    /// Adds to the diagonal, in the order of [`Self::diagonal`].
    pub fn add_to_diagonal(&mut self, added: &[f64]) {
        for (place, &block) in self.block_at.iter().enumerate() {
            for k in 0..B {
                self.values[self.col_ptr[place * B + k]] += added[block * B + k];
            }
        }
    }

    /// Factorises the present values.
    pub fn factorise(&mut self) -> Result<(), SparseError> {
        let n = self.blocks * B;
        if n == 0 {
            return Ok(());
        }
        let pattern = SymbolicSparseColMatRef::new_checked(n, n, &self.col_ptr, None, &self.row_idx);
        let outcome = self.symbolic.factorize_numeric_llt(
            &mut self.factor,
            SparseColMatRef::new(pattern, &self.values),
            Side::Lower,
            LltRegularization::default(),
            Par::Seq,
            MemStack::new(&mut self.scratch),
            Default::default(),
        );
        match outcome {
            Ok(_) => Ok(()),
            Err(LltError::NonPositivePivot { index }) => Err(SparseError::NotPositiveDefinite {
                block: self.block_at[(index / B).min(self.blocks - 1)],
            }),
        }
    }

    /// Solves for up to `B` right-hand sides with the last factor, in place. `rhs` is column-major:
    /// `[columns][blocks * B]`.
    pub fn solve_in_place(&mut self, rhs: &mut [f64], columns: usize) {
        let n = self.blocks * B;
        assert!(
            columns <= B && rhs.len() == n * columns,
            "{} values for {columns} columns of {n}",
            rhs.len()
        );
        if n == 0 {
            return;
        }
        for (from, to) in rhs.chunks_exact(n).zip(self.rhs.chunks_exact_mut(n)) {
            for (place, &block) in self.block_at.iter().enumerate() {
                to[place * B..][..B].copy_from_slice(&from[block * B..][..B]);
            }
        }
        if let SymbolicCholeskyRaw::Supernodal(symbolic) = self.symbolic.raw() {
            supernodal::SupernodalLltRef::new(symbolic, &self.factor).solve_in_place_with_conj(
                Conj::No,
                MatMut::from_column_major_slice_mut(&mut self.rhs[..n * columns], n, columns),
                Par::Seq,
                MemStack::new(&mut self.scratch),
            );
        }
        for (to, from) in rhs.chunks_exact_mut(n).zip(self.rhs.chunks_exact(n)) {
            for (place, &block) in self.block_at.iter().enumerate() {
                to[block * B..][..B].copy_from_slice(&from[place * B..][..B]);
            }
        }
    }
}

/// Approximate minimum degree order of the block graph: `(block_at, position)`.
fn minimum_degree(blocks: usize, pairs: &[(usize, usize)]) -> Result<(Vec<usize>, Vec<usize>), FaerError> {
    let mut neighbours = vec![Vec::new(); blocks];
    for &(a, b) in pairs {
        if a != b {
            neighbours[a.max(b)].push(a.min(b));
        }
    }
    let mut col_ptr = vec![0];
    let mut row_idx = Vec::new();
    for column in &mut neighbours {
        column.sort_unstable();
        column.dedup();
        row_idx.extend_from_slice(column);
        col_ptr.push(row_idx.len());
    }
    let mut block_at = vec![0; blocks];
    let mut position = vec![0; blocks];
    let mut scratch = MemBuffer::try_new(amd::order_scratch::<usize>(blocks, row_idx.len()))
        .map_err(|_| FaerError::OutOfMemory)?;
    amd::order(
        &mut block_at,
        &mut position,
        SymbolicSparseColMatRef::new_checked(blocks, blocks, &col_ptr, None, &row_idx),
        amd::Control::default(),
        MemStack::new(&mut scratch),
    )?;
    Ok((block_at, position))
}

/// Column pointers and row indices of the lower triangle, each block expanded to `B`x`B`.
fn expand_lower<const B: usize>(below: &[Vec<usize>]) -> (Vec<usize>, Vec<usize>) {
    let mut col_ptr = vec![0];
    let mut row_idx = Vec::new();
    for (column, rows) in below.iter().enumerate() {
        for b in 0..B {
            row_idx.extend(column * B + b..(column + 1) * B);
            for &row in rows {
                row_idx.extend(row * B..(row + 1) * B);
            }
            col_ptr.push(row_idx.len());
        }
    }
    (col_ptr, row_idx)
}

/// The transposed pattern; row indices come out ascending.
fn transpose(n: usize, col_ptr: &[usize], row_idx: &[usize]) -> (Vec<usize>, Vec<usize>) {
    let mut ptr = vec![0; n + 1];
    for &row in row_idx {
        ptr[row + 1] += 1;
    }
    for k in 0..n {
        ptr[k + 1] += ptr[k];
    }
    let mut next = ptr.clone();
    let mut idx = vec![0; row_idx.len()];
    for column in 0..n {
        for &row in &row_idx[col_ptr[column]..col_ptr[column + 1]] {
            idx[next[row]] = column;
            next[row] += 1;
        }
    }
    (ptr, idx)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector, Matrix2};

    #[test]
    fn a_random_block_system_is_solved_as_by_a_dense_factorisation() {
        let pairs = [(0, 3), (3, 1), (4, 0), (2, 4), (1, 2), (3, 4), (0, 3)];
        let mut system = BlockCholesky::<2>::new(5, &pairs).unwrap();
        let mut dense = DMatrix::<f64>::zeros(10, 10);
        let mut state = 1u64;
        let mut random = || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 40) as f64 / (1u64 << 24) as f64 - 0.5
        };
        for block in 0..5 {
            let value = Matrix2::new(6.0 + random(), 0.3, 0.3, 6.0 + random());
            system.add(system.slot(block, block).unwrap(), &value);
            dense.view_mut((2 * block, 2 * block), (2, 2)).copy_from(&value);
        }
        for &(a, b) in &pairs[..6] {
            let value = Matrix2::new(random(), random(), random(), random());
            system.add(system.slot(a, b).unwrap(), &value);
            dense.view_mut((2 * a, 2 * b), (2, 2)).copy_from(&value);
            dense.view_mut((2 * b, 2 * a), (2, 2)).copy_from(&value.transpose());
        }
        system.factorise().unwrap();
        let mut x: Vec<f64> = (0..20).map(|_| random()).collect();
        let b = DMatrix::from_column_slice(10, 2, &x);
        system.solve_in_place(&mut x, 2);
        let wanted = dense.lu().solve(&b).unwrap();
        let found = DMatrix::from_column_slice(10, 2, &x);
        assert!((found - wanted).norm() < 1e-12);
        assert_eq!(system.diagonal().len(), DVector::<f64>::zeros(10).len());
    }

    #[test]
    fn an_indefinite_system_names_the_block() {
        let mut system = BlockCholesky::<2>::new(3, &[(0, 1), (1, 2)]).unwrap();
        for block in [0, 2] {
            system.add(system.slot(block, block).unwrap(), &Matrix2::identity());
        }
        assert_eq!(system.factorise(), Err(SparseError::NotPositiveDefinite { block: 1 }));
    }

    #[test]
    fn one_block_and_none_are_fine() {
        let mut one = BlockCholesky::<2>::new(1, &[]).unwrap();
        one.add(one.slot(0, 0).unwrap(), &(Matrix2::identity() * 4.0));
        one.factorise().unwrap();
        let mut x = [8.0, 4.0];
        one.solve_in_place(&mut x, 1);
        assert!((x[0] - 2.0).abs() < 1e-15 && (x[1] - 1.0).abs() < 1e-15);
        let mut none = BlockCholesky::<2>::new(0, &[]).unwrap();
        none.factorise().unwrap();
    }
}
