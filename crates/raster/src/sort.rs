//! Near to far.

/// Bits that one pass sorts by.
const DIGIT: u32 = 11;
const BUCKETS: usize = 1 << DIGIT;
/// 31 bits: the sign of a depth is never set.
const PASSES: usize = 3;

/// The lower halves of `keys` in the order of their upper halves; what is equal stays in order (a radix sort,
/// lowest digit first).
pub(crate) fn by_upper_half(mut keys: Vec<u64>) -> Vec<u32> {
    let digit = |key: u64, pass: usize| (key >> (32 + DIGIT * pass as u32)) as usize & (BUCKETS - 1);
    let mut next = vec![[0u32; BUCKETS]; PASSES];
    for key in &keys {
        for (pass, counts) in next.iter_mut().enumerate() {
            counts[digit(*key, pass)] += 1;
        }
    }
    let mut sorted = vec![0u64; keys.len()];
    for (pass, next) in next.iter_mut().enumerate() {
        let mut from = 0;
        for count in next.iter_mut() {
            from += std::mem::replace(count, from);
        }
        for key in &keys {
            let place = &mut next[digit(*key, pass)];
            sorted[*place as usize] = *key;
            *place += 1;
        }
        std::mem::swap(&mut keys, &mut sorted);
    }
    keys.into_iter().map(|key| key as u32).collect()
}

#[cfg(test)]
mod tests {
    use super::by_upper_half;

    #[test]
    fn depths_come_sorted_and_equal_ones_keep_their_order() {
        let mut seed = 7u64;
        let mut keys: Vec<u64> = (0..5000u64)
            .map(|slot| {
                seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                // Some depths are often the same, some are as large as they get.
                let z = if slot % 3 == 0 {
                    (seed >> 60) as f32
                } else {
                    f32::from_bits((seed >> 33) as u32 & 0x7f7f_ffff)
                };
                (z.to_bits() as u64) << 32 | slot
            })
            .collect();
        let found = by_upper_half(keys.clone());
        keys.sort();
        assert_eq!(found, keys.iter().map(|key| *key as u32).collect::<Vec<_>>());
        assert!(by_upper_half(Vec::new()).is_empty());
    }
}
