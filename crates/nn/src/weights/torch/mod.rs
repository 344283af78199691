//! Files of `torch.save`: a zip archive with one pickle and one entry per storage, or (before torch 1.6) a sequence of pickles
//! followed by the storages. The pickle is decoded as data; see the `pickle` crate.

mod groups;
mod legacy;
mod state_dict;
mod zip_archive;

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek};
use std::path::Path;

use pickle::{Graph, Limits};

pub use groups::TensorGroup;

use super::file::Contents;
use super::{TorchFault, WeightError};

/// A Lightning checkpoint of a large model has some ten thousand objects; this leaves room for a thousand times that, and
/// bounds what a hostile file can make us hold.
const LIMITS: Limits = Limits { max_bytes: 32 << 20, max_depth: 10_000, max_values: 1 << 22, max_memo: 1 << 22 };

/// How a torch file is packed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Container {
    Zip,
    Legacy,
}

/// Bytes of one storage in the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Storage {
    start: u64,
    bytes: u64,
}

/// Storages by key.
type Storages = BTreeMap<String, Storage>;

/// Tells torch files from others by their first bytes, and goes back to the start.
pub(super) fn container(file: &mut File) -> std::io::Result<Option<Container>> {
    let mut start = Vec::new();
    file.take(legacy::START.len() as u64).read_to_end(&mut start)?;
    file.rewind()?;
    Ok(if start.starts_with(b"PK\x03\x04") {
        Some(Container::Zip)
    } else if legacy::is_start(&start) {
        Some(Container::Legacy)
    } else {
        None
    })
}

/// Finds the tensors of the state dict under `keys`, or of the one that [`super::WeightFile::open`] describes.
pub(super) fn read(
    file: &mut File,
    container: Container,
    keys: Option<&[&str]>,
    path: &Path,
) -> Result<Contents, WeightError> {
    look_into(file, container, path, |graph, storages| contents(graph, storages, keys))
}

/// Every dictionary and list that holds tensors, in the order of the file.
///
/// # Errors
/// [`WeightError::Io`], [`WeightError::Torch`] for a damaged file, [`WeightError::Layout`] for one that torch did not write.
pub fn torch_groups(path: impl AsRef<Path>) -> Result<Vec<TensorGroup>, WeightError> {
    let path = path.as_ref();
    let io = |source| WeightError::Io { source, path: path.to_path_buf() };
    let mut file = File::open(path).map_err(io)?;
    let Some(container) = container(&mut file).map_err(io)? else {
        let reason = "not a file of torch.save".to_owned();
        return Err(WeightError::Layout { reason, path: path.to_path_buf() });
    };
    look_into(&mut file, container, path, |graph, _| Ok(groups::groups(graph.root())))
}

fn look_into<T>(
    file: &mut File,
    container: Container,
    path: &Path,
    look: impl FnOnce(&Graph<'_>, &Storages) -> Result<T, TorchFault>,
) -> Result<T, WeightError> {
    let wrap = |source| WeightError::Torch { source, path: path.to_path_buf() };
    let io = |source| WeightError::Io { source, path: path.to_path_buf() };
    let file_bytes = file.metadata().map_err(io)?.len();
    match container {
        Container::Zip => {
            let (pickle, storages) = zip_archive::read(file, file_bytes).map_err(wrap)?;
            let (graph, taken) = pickle::decode_objects(&pickle, LIMITS).map_err(|error| wrap(error.into()))?;
            if taken != pickle.len() {
                return Err(wrap(TorchFault::Container("data.pkl goes on after its end marker".to_owned())));
            }
            look(&graph, &storages).map_err(wrap)
        }
        Container::Legacy => {
            let mut head = Vec::new();
            file.take(LIMITS.max_bytes as u64).read_to_end(&mut head).map_err(io)?;
            let parsed = legacy::parse(&head).map_err(wrap)?;
            let storages = legacy::storages(file, file_bytes, &parsed).map_err(wrap)?;
            look(&parsed.graph, &storages).map_err(wrap)
        }
    }
}

fn contents(graph: &Graph<'_>, storages: &Storages, keys: Option<&[&str]>) -> Result<Contents, TorchFault> {
    state_dict::tensors(state_dict::find(graph.root(), keys)?, storages)
}
