//! Mutual nearest neighbours of a confidence matrix, on the host.

/// Which cells may match.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MatchRules {
    /// Confidences must be above this.
    pub threshold: f32,
    /// Cells nearer to the border than this do not match.
    pub border: usize,
}

impl Default for MatchRules {
    /// The outdoor configuration: above 0.2, two cells from the border.
    fn default() -> Self {
        Self { threshold: 0.2, border: 2 }
    }
}

/// A pair of cells that are each other's best.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LoftrMatch {
    /// Cell of the first image, row by row; its place in pixels is 8 × (column, row).
    pub first: usize,
    /// Cell of the second image.
    pub second: usize,
    /// In (0, 1].
    pub confidence: f32,
}

/// The matches of one pair of images, by the first image's cell. Of equal confidences the first cell counts.
///
/// # Shapes
/// - confidence: `[rows · columns]` of the first grid times those of the second, row-major
/// - grids: rows and columns of cells
#[must_use]
pub fn mutual_matches(confidence: &[f32], grids: [[usize; 2]; 2], rules: MatchRules) -> Vec<LoftrMatch> {
    let [cells_first, cells_second] = grids.map(|[rows, columns]| rows * columns);
    assert_eq!(confidence.len(), cells_first * cells_second, "confidences of {cells_first} times {cells_second} cells");
    if cells_second == 0 {
        return Vec::new();
    }
    let mut column_best = vec![f32::NEG_INFINITY; cells_second];
    for row in confidence.chunks_exact(cells_second) {
        column_best.iter_mut().zip(row).for_each(|(best, value)| *best = best.max(*value));
    }
    let inside = |cell: usize, [rows, columns]: [usize; 2]| {
        let (row, column) = (cell / columns, cell % columns);
        let far = |place: usize, length: usize| place >= rules.border && place + rules.border < length;
        far(row, rows) && far(column, columns)
    };
    let best_of = |(first, row): (usize, &[f32])| {
        let best = row.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let (second, _) = row.iter().zip(&column_best).enumerate().find(|(second, (value, column))| {
            **value == best && best == **column && best > rules.threshold && inside(*second, grids[1])
        })?;
        inside(first, grids[0]).then_some(LoftrMatch { first, second, confidence: best })
    };
    confidence.chunks_exact(cells_second).enumerate().filter_map(best_of).collect()
}
