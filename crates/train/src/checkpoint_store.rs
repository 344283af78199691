//! The checkpoints of one run: `checkpoints/step_00010000/` and `best.json`.
//!
//! A checkpoint is written into `.tmp-step_…` beside its place, every file synced, then renamed, then the parent
//! synced: a run killed at any moment leaves either no new checkpoint or a whole one.

use std::fs;
use std::path::{Path, PathBuf};

use crate::TrainError;
use crate::checkpoint::{Best, CheckpointReader, CheckpointState, CheckpointWriter, STATE_FILE};
use crate::files::{replace_file, sync_folder};

const FOLDER: &str = "checkpoints";
const PREFIX: &str = "step_";
const UNFINISHED: &str = ".tmp-";
const REPLACED: &str = ".old-";

/// Folder with the checkpoints of a run; keeps the last few and the best.
#[derive(Clone, Debug)]
pub struct CheckpointStore {
    folder: PathBuf,
    keep_last: usize,
}

impl CheckpointStore {
    /// Opens `<run_dir>/checkpoints` for a run that will write there; makes the folder and removes what a killed run
    /// left unfinished. `keep_last` below 1 counts as 1.
    ///
    /// # Errors
    /// When the folder cannot be made or cleaned.
    pub fn open(run_dir: &Path, keep_last: usize) -> Result<Self, TrainError> {
        let folder = run_dir.join(FOLDER);
        fs::create_dir_all(&folder).map_err(TrainError::io("create", &folder))?;
        for entry in fs::read_dir(&folder).map_err(TrainError::io("list", &folder))? {
            let entry = entry.map_err(TrainError::io("list", &folder))?;
            let name = entry.file_name().to_string_lossy().into_owned();
            if name.starts_with(UNFINISHED) || name.starts_with(REPLACED) {
                tracing::warn!(leftover = %entry.path().display(), "removing what an interrupted save left behind");
                remove(&entry.path())?;
            }
        }
        Ok(Self { folder, keep_last: keep_last.max(1) })
    }

    /// Writes the checkpoint of `state.step` through `write`, then deletes the oldest ones beyond `keep_last`, never
    /// the best. Returns its folder.
    ///
    /// # Errors
    /// When anything cannot be written; the earlier checkpoints are untouched then.
    pub fn save(
        &self,
        state: CheckpointState,
        config_text: &str,
        write: impl FnOnce(&mut CheckpointWriter) -> Result<(), TrainError>,
    ) -> Result<PathBuf, TrainError> {
        let name = format!("{PREFIX}{:08}", state.step);
        let place = self.folder.join(&name);
        let beside = self.folder.join(format!("{UNFINISHED}{name}"));
        remove(&beside)?;
        fs::create_dir(&beside).map_err(TrainError::io("create", &beside))?;
        let mut writer = CheckpointWriter::new(&beside, config_text);
        write(&mut writer)?;
        writer.finish(state)?;
        // A folder of this step exists only when it was damaged and the run went back to an older one.
        let replaced = self.folder.join(format!("{REPLACED}{name}"));
        if place.exists() {
            remove(&replaced)?;
            fs::rename(&place, &replaced).map_err(TrainError::io("rename", &place))?;
        }
        fs::rename(&beside, &place).map_err(TrainError::io("rename", &beside))?;
        sync_folder(&self.folder)?;
        remove(&replaced)?;
        self.prune()?;
        Ok(place)
    }

    /// Makes `best.json` name the best checkpoint up to the current state; removes it when there is none. The state in
    /// the checkpoints is what counts, the file is for people and tools.
    ///
    /// # Errors
    /// When `best.json` cannot be written or removed.
    pub fn restore_best(&self, best: Option<&Best>) -> Result<(), TrainError> {
        let path = self.folder.join("best.json");
        let Some(best) = best else { return remove(&path) };
        let text = serde_json::to_string_pretty(best).map_err(|why| TrainError::damaged(why.to_string(), &path))?;
        replace_file(&path, text.as_bytes())
    }

    /// The best checkpoint so far.
    ///
    /// # Errors
    /// When `best.json` exists but cannot be read.
    pub fn best(&self) -> Result<Option<Best>, TrainError> {
        let path = self.folder.join("best.json");
        if !path.exists() {
            return Ok(None);
        }
        let text = fs::read_to_string(&path).map_err(TrainError::io("read", &path))?;
        serde_json::from_str(&text).map(Some).map_err(|why| TrainError::damaged(why.to_string(), &path))
    }

    /// The newest whole checkpoint; damaged newer ones are passed over with a warning. `None` when there is none.
    ///
    /// # Errors
    /// [`TrainError::NoCheckpoint`] when there are checkpoints but every one is damaged: starting over would hide that.
    pub fn latest(&self) -> Result<Option<CheckpointReader>, TrainError> {
        latest_in(&self.folder)
    }

    fn prune(&self) -> Result<(), TrainError> {
        let best = self.best()?.map(|best| best.step);
        let steps = steps_in(&self.folder)?;
        let kept = steps.len().saturating_sub(self.keep_last);
        for (step, path) in &steps[..kept] {
            if Some(*step) != best {
                remove(path)?;
            }
        }
        Ok(())
    }
}

/// Opens a checkpoint for use: `path` is a checkpoint folder, or a run folder, of which the newest whole one is taken.
/// Writes nothing.
///
/// # Errors
/// [`TrainError::NoCheckpoint`] when there is none, [`TrainError::Damaged`] when the named one is not whole.
pub fn find_checkpoint(path: &Path) -> Result<CheckpointReader, TrainError> {
    if path.join(STATE_FILE).exists() {
        return CheckpointReader::open(path);
    }
    let folder = path.join(FOLDER);
    let found = if folder.is_dir() { latest_in(&folder)? } else { None };
    found.ok_or_else(|| TrainError::NoCheckpoint { why: "there is none".to_string(), path: path.to_path_buf() })
}

fn latest_in(folder: &Path) -> Result<Option<CheckpointReader>, TrainError> {
    let steps = steps_in(folder)?;
    for (_, path) in steps.iter().rev() {
        match CheckpointReader::open(path) {
            Ok(reader) => return Ok(Some(reader)),
            Err(why) => tracing::warn!(checkpoint = %path.display(), %why, "damaged checkpoint, trying an older one"),
        }
    }
    match steps.last() {
        None => Ok(None),
        Some((_, path)) => {
            let why = CheckpointReader::open(path).err().map_or_else(String::new, |why| why.to_string());
            let why = format!("all {} are damaged, the newest: {why}", steps.len());
            Err(TrainError::NoCheckpoint { why, path: folder.to_path_buf() })
        }
    }
}

/// Step and folder of every checkpoint by name, oldest first.
fn steps_in(folder: &Path) -> Result<Vec<(u64, PathBuf)>, TrainError> {
    let mut steps = Vec::new();
    for entry in fs::read_dir(folder).map_err(TrainError::io("list", folder))? {
        let entry = entry.map_err(TrainError::io("list", folder))?;
        let name = entry.file_name().to_string_lossy().into_owned();
        if let Some(step) = name.strip_prefix(PREFIX).and_then(|digits| digits.parse().ok()) {
            steps.push((step, entry.path()));
        }
    }
    steps.sort();
    Ok(steps)
}

fn remove(path: &Path) -> Result<(), TrainError> {
    if path.is_dir() {
        fs::remove_dir_all(path).map_err(TrainError::io("remove", path))
    } else if path.exists() {
        fs::remove_file(path).map_err(TrainError::io("remove", path))
    } else {
        Ok(())
    }
}
