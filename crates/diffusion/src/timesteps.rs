//! Which training timesteps a sampler visits.

use serde::{Deserialize, Serialize};

/// Ways to spread N steps over the training timesteps; the names are those of diffusers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Spacing {
    /// Multiples of ⌊T / N⌋, plus an offset; Stable Diffusion's offset is 1. Multistep solvers take ⌊T / (N + 1)⌋ and drop the smallest.
    Leading {
        /// Added to every timestep.
        offset: usize,
    },
    /// Even from T − 1 down to 0, both included; multistep solvers leave 0 out.
    Linspace,
    /// As [`Spacing::Linspace`], rounded to whole timesteps, halves to the even one (DiT's code).
    Rounded,
    /// Even from T − 1 down, so that the noisiest timestep is always visited.
    Trailing,
    /// Integer parts of an even line from T − 1 down to 0, 0 excluded (Panacea's code).
    FlooredLinspace,
}

impl Spacing {
    /// Descending timesteps of samplers that go from each timestep to the next.
    pub(crate) fn visits(self, steps: usize, total: usize) -> Vec<f64> {
        let last = (total - 1) as f64;
        let ascending = |value: &dyn Fn(f64) -> f64| (0..steps).map(|i| value(i as f64)).rev().collect();
        match self {
            Self::Leading { offset } => ascending(&|i| i * (total / steps) as f64 + offset as f64),
            Self::Linspace if steps == 1 => vec![0.0],
            Self::Linspace => ascending(&|i| i * last / (steps - 1) as f64),
            Self::Rounded => Self::Linspace.visits(steps, total).into_iter().map(f64::round_ties_even).collect(),
            Self::Trailing => trailing(steps, total),
            Self::FlooredLinspace => (0..steps).map(|i| (last - i as f64 * last / steps as f64).floor()).collect(),
        }
    }

    /// Descending timesteps of multistep solvers, whose last step goes to a level of its own.
    pub(crate) fn visits_before_end(self, steps: usize, total: usize) -> Vec<f64> {
        let last = (total - 1) as f64;
        match self {
            Self::Leading { offset } => {
                (1..=steps).rev().map(|i| (i * (total / (steps + 1)) + offset) as f64).collect()
            }
            Self::Linspace | Self::Rounded => {
                (1..=steps).rev().map(|i| (i as f64 * last / steps as f64).round_ties_even()).collect()
            }
            Self::Trailing | Self::FlooredLinspace => self.visits(steps, total),
        }
    }
}

fn trailing(steps: usize, total: usize) -> Vec<f64> {
    let stride = total as f64 / steps as f64;
    (0..steps).map(|i| (total as f64 - i as f64 * stride).round_ties_even() - 1.0).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_are_those_of_the_specification() {
        let ddim = Spacing::Leading { offset: 1 }.visits(25, 1000);
        assert_eq!((ddim[0], ddim[1], ddim[24]), (961.0, 921.0, 1.0));
        let unipc = Spacing::Linspace.visits_before_end(20, 1000);
        assert_eq!(
            (unipc[0], unipc[1], unipc[9], unipc[10], unipc[11], unipc[19]),
            (999.0, 949.0, 549.0, 500.0, 450.0, 50.0)
        );
        let panacea = Spacing::FlooredLinspace.visits(25, 1000);
        assert_eq!((panacea[0], panacea[1], panacea[2], panacea[24]), (999.0, 959.0, 919.0, 39.0));
        assert_eq!(Spacing::Trailing.visits(4, 1000), [999.0, 749.0, 499.0, 249.0]);
        for steps in [1, 2, 7, 1000] {
            for spacing in
                [Spacing::Leading { offset: 0 }, Spacing::Linspace, Spacing::Trailing, Spacing::FlooredLinspace]
            {
                let list = spacing.visits(steps, 1000);
                assert_eq!(list.len(), steps);
                assert!(list.windows(2).all(|pair| pair[0] > pair[1]), "{spacing:?} {steps}");
                assert!(list.iter().all(|t| (0.0..1000.0).contains(t)));
            }
        }
    }
}
