//! What ControlNets add to the UNet.

use burn::tensor::Tensor;

/// One tensor per skip of the UNet, in the order in which the skips are made, and one for its middle.
#[derive(Debug, Clone)]
pub struct ControlResiduals {
    /// Added to the skips.
    pub down: Vec<Tensor<4>>,
    /// Added to the middle's output.
    pub middle: Tensor<4>,
}

impl ControlResiduals {
    /// All residuals times `scale`.
    #[must_use]
    pub fn scaled(self, scale: f64) -> Self {
        Self { down: self.down.into_iter().map(|r| r * scale).collect(), middle: self.middle * scale }
    }

    /// The residuals of two ControlNets together.
    ///
    /// # Panics
    /// When they belong to different UNets.
    #[must_use]
    pub fn plus(self, other: Self) -> Self {
        assert_eq!(self.down.len(), other.down.len(), "residuals for one UNet");
        let down = self.down.into_iter().zip(other.down).map(|(a, b)| a + b).collect();
        Self { down, middle: self.middle + other.middle }
    }

    /// Adds to the UNet's skips in place and returns its middle with the middle's residual.
    pub(crate) fn add_to(&self, skips: &mut [Tensor<4>], middle: Tensor<4>) -> Tensor<4> {
        assert_eq!(self.down.len(), skips.len(), "one residual per skip");
        for (skip, residual) in skips.iter_mut().zip(&self.down) {
            *skip = skip.clone() + residual.clone();
        }
        middle + self.middle.clone()
    }
}
