//! Mean and deviation of latents, measured once over the training set (the specification of the DiT stage, section 2.1).

use std::path::Path;

use geometry::BevGrid;
use serde::{Deserialize, Serialize};

use super::{Latent, json_error, write_whole};
use crate::DataError;

/// The file's name.
pub const STATISTICS: &str = "latent_stats.json";
/// Deviations below this make numbers of any size out of nothing.
const LEAST_STD: f64 = 1e-6;

/// What of the posterior was measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Posterior {
    /// Samples: the posterior's own variance counts.
    Sample,
    /// Its mean, or the one point that was kept.
    Mean,
}

/// `latent_stats.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LatentStatistics {
    /// SHA-256 of the autoencoder's averaged weights file.
    pub vae_hash: String,
    /// Names of the datasets, joined by `+`.
    pub dataset: String,
    /// Samples measured.
    pub count: u64,
    /// What was measured.
    pub posterior: Posterior,
    /// Of each channel, `[C]`.
    pub mean: Vec<f64>,
    /// Of each channel, `[C]`.
    pub std: Vec<f64>,
    /// Over all channels.
    pub global_mean: f64,
    /// Over all channels, about `global_mean`.
    pub global_std: f64,
    /// Grid of the autoencoder, over which layouts are rasterised.
    pub grid: BevGrid,
}

/// How latents become numbers of unit variance.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LatentScale {
    /// z / σ of all channels together.
    #[default]
    Global,
    /// (z − m) / σ of each channel.
    PerChannel,
}

impl LatentStatistics {
    /// Reads the file.
    ///
    /// # Errors
    /// [`DataError::Missing`], [`DataError::Json`], and [`DataError::Format`] for numbers that no latents have.
    pub fn read(path: &Path) -> Result<Self, DataError> {
        let text = std::fs::read_to_string(path).map_err(|source| match source.kind() {
            std::io::ErrorKind::NotFound => DataError::Missing {
                what: "statistics of the latents; run `rigscape encode`".into(),
                path: path.into(),
            },
            _ => DataError::Io { action: "read", source, path: path.into() },
        })?;
        let read: Self = serde_json::from_str(&text).map_err(json_error(path))?;
        read.checked().map_err(|why| DataError::Format { format: "latent statistics", why, path: path.into() })
    }

    /// Writes the file.
    ///
    /// # Errors
    /// Names the file.
    pub fn write(&self, path: &Path) -> Result<(), DataError> {
        write_whole(path, &serde_json::to_vec_pretty(self).map_err(json_error(path))?)
    }

    /// Refuses numbers that scale nothing.
    ///
    /// # Errors
    /// A sentence.
    pub fn checked(self) -> Result<Self, String> {
        let numbers = self.mean.iter().chain(&self.std).chain([&self.global_mean, &self.global_std]);
        if self.mean.is_empty() || self.mean.len() != self.std.len() {
            return Err(format!("{} means and {} deviations", self.mean.len(), self.std.len()));
        }
        if numbers.into_iter().any(|value| !value.is_finite()) || self.count == 0 {
            return Err("there are no finite numbers of at least one sample".to_owned());
        }
        if self.std.iter().chain([&self.global_std]).any(|std| *std < LEAST_STD) {
            return Err(format!("a deviation is below {LEAST_STD}; the autoencoder's latents are constant"));
        }
        self.grid.checked().map_err(|error| error.to_string())?;
        Ok(self)
    }

    /// Offset and factor of each channel: `x0 = (z − offset) · factor`.
    pub fn scaling(&self, scale: LatentScale) -> Vec<(f64, f64)> {
        match scale {
            LatentScale::Global => vec![(0.0, 1.0 / self.global_std); self.mean.len()],
            LatentScale::PerChannel => self.mean.iter().zip(&self.std).map(|(mean, std)| (*mean, 1.0 / std)).collect(),
        }
    }

    /// Refuses latents of another autoencoder or over another grid.
    ///
    /// # Errors
    /// A sentence with both sides.
    pub fn check_origin(&self, vae_hash: &str, grid: &BevGrid) -> Result<(), String> {
        if self.vae_hash != vae_hash {
            let (made, asked) = (&self.vae_hash, vae_hash);
            return Err(format!(
                "the latents come from the autoencoder {made}, this one is {asked}; encode again with it"
            ));
        }
        if self.grid != *grid {
            let (made, asked) = (&self.grid, grid);
            return Err(format!("the latents were made over the grid {made:?}, the autoencoder has {asked:?}"));
        }
        Ok(())
    }
}

/// Count, mean and sum of squared differences from it.
#[derive(Debug, Clone, Copy, Default)]
struct Moments {
    count: f64,
    mean: f64,
    squares: f64,
}

impl Moments {
    fn of(values: impl Iterator<Item = f64> + Clone) -> Self {
        let (count, sum) = values.clone().fold((0.0, 0.0), |(count, sum), value| (count + 1.0, sum + value));
        let mean = if count > 0.0 { sum / count } else { 0.0 };
        Self { count, mean, squares: values.map(|value| (value - mean).powi(2)).sum() }
    }

    /// Chan, Golub & LeVeque, "Updating Formulae and a Pairwise Algorithm for Computing Sample Variances".
    fn merged(self, other: Self) -> Self {
        let count = self.count + other.count;
        if count == 0.0 {
            return self;
        }
        let apart = other.mean - self.mean;
        Self {
            count,
            mean: self.mean + apart * other.count / count,
            squares: self.squares + other.squares + apart * apart * self.count * other.count / count,
        }
    }

    fn std(self) -> f64 {
        if self.count > 0.0 { (self.squares / self.count).sqrt() } else { 0.0 }
    }
}

/// Streams latents, in f64.
#[derive(Debug, Clone)]
pub struct StatisticsCollector {
    posterior: Posterior,
    samples: u64,
    channels: Vec<Moments>,
}

impl StatisticsCollector {
    /// For latents of so many channels.
    pub fn new(channels: usize, posterior: Posterior) -> Self {
        Self { posterior, samples: 0, channels: vec![Moments::default(); channels] }
    }

    /// Adds one sample.
    pub fn add(&mut self, latent: &Latent) {
        let cells = (latent.mean.len() / self.channels.len().max(1)).max(1);
        let log_vars = latent.log_var.as_deref().unwrap_or_default();
        for (at, channel) in self.channels.iter_mut().enumerate() {
            let range = at * cells..(at + 1) * cells;
            let means = latent.mean.get(range.clone()).unwrap_or_default();
            let mut own = Moments::of(means.iter().map(|value| f64::from(*value)));
            if self.posterior == Posterior::Sample {
                // The expected square of a draw exceeds that of the mean by the posterior's variance.
                own.squares +=
                    log_vars.get(range).unwrap_or_default().iter().map(|value| f64::from(*value).exp()).sum::<f64>();
            }
            *channel = channel.merged(own);
        }
        self.samples += 1;
    }

    /// The figures.
    ///
    /// # Errors
    /// A sentence where there are no samples, or only constant ones.
    pub fn finish(self, vae_hash: &str, dataset: &str, grid: &BevGrid) -> Result<LatentStatistics, String> {
        let global = self.channels.iter().fold(Moments::default(), |all, channel| all.merged(*channel));
        LatentStatistics {
            vae_hash: vae_hash.to_owned(),
            dataset: dataset.to_owned(),
            count: self.samples,
            posterior: self.posterior,
            mean: self.channels.iter().map(|channel| channel.mean).collect(),
            std: self.channels.iter().map(|channel| channel.std()).collect(),
            global_mean: global.mean,
            global_std: global.std(),
            grid: *grid,
        }
        .checked()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GRID: BevGrid =
        BevGrid { x_range: [-8.0, 8.0], y_range: [-8.0, 8.0], z_range: [-1.0, 3.0], cells: [4, 8, 8] };

    fn measured(posterior: Posterior) -> LatentStatistics {
        let mut collector = StatisticsCollector::new(2, posterior);
        let log_var = Some(vec![0.0f32, 0.0, 4f32.ln(), 4f32.ln()]);
        collector.add(&Latent { mean: vec![1.0, 3.0, -2.0, -2.0], log_var: log_var.clone() });
        collector.add(&Latent { mean: vec![5.0, 7.0, 2.0, 2.0], log_var });
        collector.finish("hash", "a+b", &GRID).unwrap()
    }

    #[test]
    fn figures_are_those_of_all_numbers_at_once() {
        let mean = measured(Posterior::Mean);
        assert_eq!((mean.count, mean.mean.as_slice()), (2, &[4.0, 0.0][..]));
        // 1 3 5 7 about 4, and ±2 about 0.
        assert!((mean.std[0] - 5f64.sqrt()).abs() < 1e-12 && (mean.std[1] - 2.0).abs() < 1e-12);
        assert!((mean.global_mean - 2.0).abs() < 1e-12);
        // Squares about 2: 1 1 9 25, 16 16 0 0.
        assert!((mean.global_std - (68f64 / 8.0).sqrt()).abs() < 1e-12);
        let sample = measured(Posterior::Sample);
        assert!((sample.std[0] - 6f64.sqrt()).abs() < 1e-6 && (sample.std[1] - 8f64.sqrt()).abs() < 1e-6);
    }

    #[test]
    fn scaled_latents_have_unit_variance() {
        let statistics = measured(Posterior::Mean);
        for scale in [LatentScale::Global, LatentScale::PerChannel] {
            let scaling = statistics.scaling(scale);
            let scaled = [1.0, 3.0, 5.0, 7.0].map(|z| (z - scaling[0].0) * scaling[0].1);
            let rest = [-2.0, -2.0, 2.0, 2.0].map(|z| (z - scaling[1].0) * scaling[1].1);
            let std = Moments::of(scaled.into_iter().chain(rest)).std();
            assert!((std - 1.0).abs() < 1e-12, "{scale:?}: {std}");
        }
    }

    #[test]
    fn the_file_comes_back_and_other_origins_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(STATISTICS);
        let missing = LatentStatistics::read(&path).unwrap_err().to_string();
        assert!(missing.contains(STATISTICS) && missing.contains("rigscape encode"), "{missing}");
        let statistics = measured(Posterior::Mean);
        statistics.write(&path).unwrap();
        assert_eq!(LatentStatistics::read(&path).unwrap(), statistics);
        statistics.check_origin("hash", &GRID).unwrap();
        assert!(statistics.check_origin("other", &GRID).unwrap_err().contains("other"));
        let wider = BevGrid { x_range: [-9.0, 9.0], ..GRID };
        assert!(statistics.check_origin("hash", &wider).unwrap_err().contains("9.0"));
        LatentStatistics { std: vec![0.0, 1.0], ..statistics }.write(&path).unwrap();
        let constant = LatentStatistics::read(&path).unwrap_err().to_string();
        assert!(constant.contains("constant"), "{constant}");
    }
}
