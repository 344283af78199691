//! Which frame of which dataset a command looks at.

use std::sync::Arc;

use clap::Args;
use data::SceneDataset;

use super::common::UsageError;
use super::data_source::DataSource;

/// A frame of a dataset.
#[derive(Debug, Clone, Args)]
pub struct FrameArgs {
    /// Where the dataset is
    #[command(flatten)]
    pub source: DataSource,
    /// Which of several datasets, counted from 0 in the file's order
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub dataset: usize,
    /// Frame, counted from 0 over all scenes, or within --scene
    #[arg(long, value_name = "N", conflicts_with = "time")]
    pub index: Option<usize>,
    /// Scene by name
    #[arg(long, value_name = "NAME")]
    pub scene: Option<String>,
    /// The frame nearest to this time after the scene's first frame, seconds [default scene: the first]
    #[arg(long, value_name = "SECS")]
    pub time: Option<f64>,
}

impl FrameArgs {
    /// Opens the dataset and finds the frame.
    ///
    /// # Errors
    /// [`UsageError`] for options that name nothing; unreadable data, naming the file.
    pub fn open(&self) -> anyhow::Result<(Arc<dyn SceneDataset>, usize)> {
        let chosen = self.source.choose()?;
        let Some(named) = chosen.datasets.get(self.dataset) else {
            let text = format!("there is no dataset {}, only {}", self.dataset, chosen.datasets.len());
            return Err(UsageError::of(text));
        };
        let dataset = data::open(&named.config)?;
        let index = find(&*dataset, self)?;
        Ok((dataset, index))
    }
}

/// The index of the frame that the options name.
fn find(dataset: &dyn SceneDataset, args: &FrameArgs) -> anyhow::Result<usize> {
    let mut range = 0..dataset.len();
    if let Some(name) = &args.scene {
        let mut known = Vec::new();
        let mut found = None;
        for scene in dataset.scene_ranges().into_iter().filter(|scene| !scene.is_empty()) {
            let id = dataset.frame(scene.start)?.id;
            if id.scene == *name {
                found = Some(scene);
                break;
            }
            known.push(id.scene);
        }
        range = found.ok_or_else(|| {
            let first: Vec<&str> = known.iter().take(20).map(String::as_str).collect();
            UsageError::of(format!("no scene is called {name:?}; the first are {}", first.join(", ")))
        })?;
    } else if args.time.is_some() {
        range = dataset.scene_ranges().into_iter().next().unwrap_or(0..0);
    }
    if range.is_empty() {
        return Err(UsageError::of(format!("{} has no frames", dataset.name())));
    }
    let Some(seconds) = args.time else {
        let index = args.index.unwrap_or(0);
        return range.clone().nth(index).ok_or_else(|| {
            UsageError::of(format!("there is no frame {index}, only {} (counted from 0)", range.len()))
        });
    };
    nearest(dataset, range, seconds)
}

fn nearest(dataset: &dyn SceneDataset, range: std::ops::Range<usize>, seconds: f64) -> anyhow::Result<usize> {
    let start_ns = dataset.frame(range.start)?.timestamp_ns;
    let mut best = (f64::INFINITY, range.start);
    for index in range {
        let after = (dataset.frame(index)?.timestamp_ns - start_ns) as f64 * 1e-9;
        let distance = (after - seconds).abs();
        if distance < best.0 {
            best = (distance, index);
        }
    }
    Ok(best.1)
}
