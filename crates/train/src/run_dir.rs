//! The folder of one run: `config.toml`, `metrics.jsonl`, TensorBoard events, `previews/`, `checkpoints/`.

use std::fs;
use std::path::{Path, PathBuf};

use crate::TrainError;
use crate::files::{replace_file, sync_folder};
use crate::git::head_commit;

/// What to do with a run folder that already holds something.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OnExisting {
    /// Refuse it.
    Refuse,
    /// Go on in it.
    Resume,
    /// Take `<name>-2`, `<name>-3`, … instead.
    NextFreeName,
}

/// A run's folder.
#[derive(Clone, Debug)]
pub struct RunDir {
    path: PathBuf,
}

impl RunDir {
    /// Makes `<root>/<name>`, parents included.
    ///
    /// # Errors
    /// [`TrainError::RunExists`] for a non-empty folder under [`OnExisting::Refuse`]; a name that is more than one plain
    /// path part; a folder that cannot be made.
    pub fn create(root: &Path, name: &str, on_existing: OnExisting) -> Result<Self, TrainError> {
        let plain = Path::new(name).components().count() == 1 && !name.starts_with('.') && !name.contains(['/', '\\']);
        if !plain {
            return Err(TrainError::Config(format!("run name {name:?} is not a plain folder name")));
        }
        let mut path = root.join(name);
        if on_existing != OnExisting::Resume {
            let mut number = 1;
            while occupied(&path)? {
                if on_existing == OnExisting::Refuse {
                    return Err(TrainError::RunExists { path });
                }
                number += 1;
                path = root.join(format!("{name}-{number}"));
            }
        }
        fs::create_dir_all(&path).map_err(TrainError::io("create", &path))?;
        sync_folder(root)?;
        Ok(Self { path })
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Writes the resolved config as `config.toml`, with the source's git commit in a comment when `source` (any folder
    /// of the checkout) is in a repository.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write_config(&self, text: &str, source: &Path) -> Result<(), TrainError> {
        let commit = head_commit(source).unwrap_or_else(|| "unknown".to_string());
        replace_file(&self.path.join("config.toml"), format!("# git commit: {commit}\n{text}").as_bytes())
    }

    /// Makes and returns `previews/step_<step>`.
    ///
    /// # Errors
    /// When the folder cannot be made.
    pub fn preview_folder(&self, step: u64) -> Result<PathBuf, TrainError> {
        let folder = self.path.join("previews").join(format!("step_{step:08}"));
        fs::create_dir_all(&folder).map_err(TrainError::io("create", &folder))?;
        Ok(folder)
    }
}

fn occupied(path: &Path) -> Result<bool, TrainError> {
    if !path.exists() {
        return Ok(false);
    }
    let mut entries = fs::read_dir(path).map_err(TrainError::io("list", path))?;
    Ok(entries.next().is_some())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_existing_run_is_refused_continued_or_renamed() {
        let root = tempfile::tempdir().unwrap();
        let open = |on_existing| RunDir::create(root.path(), "toy", on_existing);
        let first = open(OnExisting::Refuse).unwrap();
        open(OnExisting::Refuse).unwrap(); // still empty
        first.write_config("seed = 1\n", root.path()).unwrap();
        assert_eq!(fs::read_to_string(first.path().join("config.toml")).unwrap(), "# git commit: unknown\nseed = 1\n");
        assert!(matches!(open(OnExisting::Refuse), Err(TrainError::RunExists { .. })));
        assert_eq!(open(OnExisting::Resume).unwrap().path(), first.path());
        assert_eq!(open(OnExisting::NextFreeName).unwrap().path(), root.path().join("toy-2"));
        for name in ["../toy", "a/b", "", ".hidden", "/toy"] {
            assert!(
                matches!(RunDir::create(root.path(), name, OnExisting::Refuse), Err(TrainError::Config(_))),
                "{name}"
            );
        }
    }
}
