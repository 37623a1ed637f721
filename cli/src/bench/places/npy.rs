//! Arrays of numbers as NumPy reads them.

/// A `.npy` file, version 1.0: little-endian floats, `[rows, columns]`. All rows are equally long.
pub fn of_rows(rows: &[Vec<f32>]) -> Vec<u8> {
    let columns = rows.first().map_or(0, Vec::len);
    let fields =
        format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({}, {columns}), }}", rows.len());
    // Magic, version and length take 10 bytes; what follows the header begins at a multiple of 64.
    let length = (10 + fields.len() + 1).next_multiple_of(64) - 10;
    let mut out = b"\x93NUMPY\x01\x00".to_vec();
    out.extend((length as u16).to_le_bytes());
    out.extend(format!("{fields:<width$}\n", width = length - 1).into_bytes());
    rows.iter().flatten().for_each(|v| out.extend(v.to_le_bytes()));
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_header_is_aligned_and_the_values_follow() {
        let bytes = of_rows(&[vec![1.0, 2.0, 3.0], vec![4.0, 5.0, 6.0]]);
        assert_eq!(&bytes[..8], b"\x93NUMPY\x01\x00");
        let end = 10 + u16::from_le_bytes([bytes[8], bytes[9]]) as usize;
        assert!(end.is_multiple_of(64) && bytes[end - 1] == b'\n');
        let header = std::str::from_utf8(&bytes[10..end]).unwrap();
        assert!(header.contains("'shape': (2, 3)"), "{header}");
        assert_eq!(bytes.len(), end + 24);
        assert_eq!(bytes[end + 20..], 6f32.to_le_bytes());
    }
}
