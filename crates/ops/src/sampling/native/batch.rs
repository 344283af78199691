//! Corners and linear weights of many points of one level at once.

/// Points per batch: enough for full vectors, few enough to stay in the first-level cache.
pub(super) const POINTS: usize = 64;

/// One number per point.
type Lane = [f32; POINTS];

/// The `K` = 2^d corners around each point of a batch. Corner k lies on the upper side of axis a where bit a of k is set.
pub(super) struct Batch<const K: usize> {
    /// Positions in pixels, per axis x, y, z; set by the caller.
    pub position: [Lane; 3],
    /// Row of each corner: its site times the pitch.
    pub row: [[u32; POINTS]; K],
    /// Linear weight of each corner, 0 outside the map.
    pub weight: [Lane; K],
    /// Per axis, weight of the lower and the upper neighbour.
    side: [[Lane; 2]; 3],
    /// Per axis, derivatives of these two weights by the coordinate.
    slope: [[Lane; 2]; 3],
}

impl<const K: usize> Batch<K> {
    /// Coordinates per point.
    pub const AXES: usize = K.trailing_zeros() as usize;

    pub fn new() -> Self {
        Self {
            position: [[0.0; POINTS]; 3],
            row: [[0; POINTS]; K],
            weight: [[0.0; POINTS]; K],
            side: [[[0.0; POINTS]; 2]; 3],
            slope: [[[0.0; POINTS]; 2]; 3],
        }
    }

    /// Finds the corners of all positions on a map of `extent`, whose sites are `pitch` rows apart.
    #[inline(always)]
    pub fn locate(&mut self, extent: [usize; 3], pitch: usize) {
        for weight in &mut self.weight {
            *weight = [1.0; POINTS];
        }
        self.row = [[0; POINTS]; K];
        let mut stride = pitch as u32;
        for (a, &size) in extent.iter().enumerate().take(Self::AXES) {
            let mut index = [[0u32; POINTS]; 2];
            neighbours(&self.position[a], size, &mut index, &mut self.side[a], &mut self.slope[a]);
            for k in 0..K {
                let upper = k >> a & 1;
                for i in 0..POINTS {
                    self.row[k][i] += index[upper][i] * stride;
                    self.weight[k][i] *= self.side[a][upper][i];
                }
            }
            stride *= size as u32;
        }
    }

    /// Derivatives by coordinate `along` of linear samples whose corner values are `corner`.
    #[inline(always)]
    pub fn slopes(&self, along: usize, corner: &[Lane; K]) -> Lane {
        let mut total = [0.0; POINTS];
        for (k, corner) in corner.iter().enumerate() {
            let mut product = *corner;
            for a in 0..Self::AXES {
                let factor = if a == along { &self.slope } else { &self.side };
                let factor = &factor[a][k >> a & 1];
                for i in 0..POINTS {
                    product[i] *= factor[i];
                }
            }
            for i in 0..POINTS {
                total[i] += product[i];
            }
        }
        total
    }

    /// Linear samples whose corner values are `corner`.
    #[inline(always)]
    pub fn samples(&self, corner: &[Lane; K]) -> Lane {
        let mut total = [0.0; POINTS];
        for k in 0..K {
            for i in 0..POINTS {
                total[i] += self.weight[k][i] * corner[k][i];
            }
        }
        total
    }
}

/// Clamped indices, weights and slopes of the two neighbours along one axis.
#[inline(always)]
fn neighbours(
    position: &Lane,
    size: usize,
    index: &mut [[u32; POINTS]; 2],
    side: &mut [Lane; 2],
    slope: &mut [Lane; 2],
) {
    /// 1.5·2²³: added to a small integer-valued float, its bits are this constant's plus the integer.
    const INTEGER: f32 = 12_582_912.0;
    let last = size as i32 - 1;
    for i in 0..POINTS {
        let floor = position[i].floor();
        let fraction = position[i] - floor;
        // Beyond these limits both neighbours are outside. `max` turns NaN into -2, but the fraction stays NaN.
        let lower = (floor.max(-2.0).min(size as f32) + INTEGER).to_bits() as i32 - INTEGER.to_bits() as i32;
        let upper = lower + 1;
        let inside =
            [if lower >= 0 && lower <= last { 1.0 } else { 0.0 }, if upper >= 0 && upper <= last { 1.0 } else { 0.0 }];
        index[0][i] = lower.max(0).min(last) as u32;
        index[1][i] = upper.max(0).min(last) as u32;
        // Products, not selections: they keep NaN.
        side[0][i] = (1.0 - fraction) * inside[0];
        side[1][i] = fraction * inside[1];
        slope[0][i] = -inside[0];
        slope[1][i] = inside[1];
    }
}
