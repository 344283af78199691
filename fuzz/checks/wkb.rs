//! Any bytes are refused or give shapes that their bytes can hold.

use data::nuplan::wkb;

/// What must hold for any bytes.
pub fn check(bytes: &[u8]) {
    let Ok(cell) = wkb::parse(bytes) else { return };
    let rings = cell.polygons.iter().flat_map(|polygon| std::iter::once(&polygon.outer).chain(&polygon.holes));
    let mut points = 0;
    for (outline, least) in cell.lines.iter().map(|line| (line, 2)).chain(rings.map(|ring| (ring, 3))) {
        assert!(outline.len() >= least && outline.iter().all(|point| point.is_finite()));
        points += outline.len();
    }
    assert!(16 * points < bytes.len());
}
