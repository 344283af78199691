//! Matches out of a table of similarities, as LoFTR's coarse stage makes them.
//!
//! Sun et al., "LoFTR: Detector-Free Local Feature Matching with Transformers", section 3.3.

/// Matches below this confidence do not count.
const LEAST_CONFIDENCE: f64 = 0.2;

/// Cells along the border of the grid that match nothing.
const BORDER: usize = 2;

/// Confidences of the matches between two grids of equal size: softmax over rows times softmax over columns, mutually largest, above 0.2,
/// at least two cells from the border on both sides. In the order of the first grid's cells.
///
/// # Shapes
/// - similarity: `[L, L]` with `L = rows · columns`, divided by the temperature already
///
/// # Panics
/// When the length does not fit the grid.
#[must_use]
pub fn mutual_matches(similarity: &[f32], [rows, columns]: [usize; 2]) -> Vec<f32> {
    let cells = rows * columns;
    assert_eq!(similarity.len(), cells * cells, "similarities of a grid {rows}x{columns}");
    let at = |i: usize, j: usize| f64::from(similarity[i * cells + j]);
    let by_row: Vec<f64> = (0..cells).map(|i| log_sum((0..cells).map(|j| at(i, j)))).collect();
    let by_column: Vec<f64> = (0..cells).map(|j| log_sum((0..cells).map(|i| at(i, j)))).collect();
    let logarithm = |i: usize, j: usize| 2.0 * at(i, j) - by_row[i] - by_column[j];
    let best_row: Vec<Option<usize>> =
        (0..cells).map(|j| (0..cells).max_by(|a, b| logarithm(*a, j).total_cmp(&logarithm(*b, j)))).collect();
    let inside = |cell: usize| {
        let (row, column) = (cell / columns, cell % columns);
        (BORDER..rows.saturating_sub(BORDER)).contains(&row)
            && (BORDER..columns.saturating_sub(BORDER)).contains(&column)
    };
    let one = |i: usize| {
        let j = (0..cells).max_by(|a, b| logarithm(i, *a).total_cmp(&logarithm(i, *b)))?;
        let confidence = logarithm(i, j).exp();
        let counts = best_row[j] == Some(i) && confidence > LEAST_CONFIDENCE && inside(i) && inside(j);
        counts.then_some(confidence as f32)
    };
    (0..cells).filter_map(one).collect()
}

fn log_sum(values: impl Iterator<Item = f64> + Clone) -> f64 {
    let largest = values.clone().fold(f64::NEG_INFINITY, f64::max);
    largest + values.map(|value| (value - largest).exp()).sum::<f64>().ln()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clear_pairs_match_and_borders_do_not() {
        let (rows, columns) = (5, 6);
        let cells = rows * columns;
        let mut similarity = vec![0.0_f32; cells * cells];
        (0..cells).for_each(|cell| similarity[cell * cells + cell] = 50.0);
        // One row and two columns lie inside the border.
        let found = mutual_matches(&similarity, [rows, columns]);
        assert_eq!(found.len(), 2);
        assert!(found.iter().all(|confidence| (confidence - 1.0).abs() < 1e-6));
        assert!(
            mutual_matches(&vec![0.0; cells * cells], [rows, columns]).is_empty(),
            "equal similarities are no match"
        );
        assert!(mutual_matches(&[1.0], [1, 1]).is_empty());
    }

    #[test]
    fn the_confidence_is_a_product_of_two_softmaxes() {
        let mut similarity = vec![-40.0_f32; 25 * 25];
        let middle = 12;
        (0..25).for_each(|cell| similarity[cell * 25 + cell] = 10.0);
        similarity[middle * 25 + 3] = 10.0 - 2.0_f32.ln();
        // The row holds 1 and 1/2, the column only 1.
        let found = mutual_matches(&similarity, [5, 5]);
        assert_eq!(found.len(), 1);
        assert!((found[0] - 1.0 / 1.5).abs() < 1e-5, "{found:?}");
    }
}
