//! The corners around a point and their linear weights.

/// The two neighbours of a coordinate along one axis.
#[derive(Clone, Copy)]
struct Axis {
    /// Clamped indices of the lower and upper neighbour.
    index: [usize; 2],
    /// Their weights, 0 outside the map.
    weight: [f32; 2],
    /// Derivatives of the weights by the coordinate.
    slope: [f32; 2],
}

impl Axis {
    #[inline(always)]
    fn new(position: f32, size: usize) -> Self {
        let floor = position.floor();
        let fraction = position - floor;
        let lower = floor as i32;
        let last = size as i32 - 1;
        let upper = lower.saturating_add(1);
        let inside = [(lower >= 0 && lower <= last) as u8 as f32, (upper >= 0 && upper <= last) as u8 as f32];
        Self {
            index: [lower.clamp(0, last) as usize, upper.clamp(0, last) as usize],
            weight: [(1.0 - fraction) * inside[0], fraction * inside[1]],
            slope: [-inside[0], inside[1]],
        }
    }

    #[inline(always)]
    fn outside(&self) -> bool {
        self.slope == [0.0, 0.0]
    }
}

/// The `K` = 2^d corners around a point of one level.
pub(super) struct Corners<const K: usize> {
    axes: [Axis; 3],
    /// Site of each corner inside the level.
    pub site: [usize; K],
    /// Linear weight of each corner.
    pub weight: [f32; K],
}

impl<const K: usize> Corners<K> {
    const AXES: usize = K.trailing_zeros() as usize;

    /// Corners of `position` in pixels, (x, y) or (x, y, z), or `None` where all of them lie outside.
    #[inline(always)]
    pub fn new(position: [f32; 3], extent: [usize; 3]) -> Option<Self> {
        let mut axes = [Axis { index: [0; 2], weight: [0.0; 2], slope: [0.0; 2] }; 3];
        for a in 0..Self::AXES {
            axes[a] = Axis::new(position[a], extent[a]);
            if axes[a].outside() {
                return None;
            }
        }
        let mut site = [0; K];
        let mut weight = [1.0; K];
        for k in 0..K {
            let mut stride = 1;
            for a in 0..Self::AXES {
                let side = k >> a & 1;
                site[k] += axes[a].index[side] * stride;
                weight[k] *= axes[a].weight[side];
                stride *= extent[a];
            }
        }
        Some(Self { axes, site, weight })
    }

    /// Derivative by coordinate `along` of the linear sample whose corner values are `corner`.
    #[inline(always)]
    pub fn slope(&self, along: usize, corner: &[f32; K]) -> f32 {
        let mut total = 0.0;
        for k in 0..K {
            let mut product = corner[k];
            for a in 0..Self::AXES {
                let side = k >> a & 1;
                product *= if a == along { self.axes[a].slope[side] } else { self.axes[a].weight[side] };
            }
            total += product;
        }
        total
    }
}

/// Position in pixels of one sample point.
#[inline(always)]
pub(super) fn position<const K: usize>(reference: &[f32], offset: &[f32], extent: [usize; 3], centre: f32) -> [f32; 3] {
    let mut position = [0.0; 3];
    for a in 0..Corners::<K>::AXES {
        position[a] = reference[a] * extent[a] as f32 + offset[a] - centre;
    }
    position
}
