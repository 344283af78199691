//! Where in a torch file tensors lie: the dictionaries and lists that hold some.

use pickle::Object;

use super::state_dict::{is_tensor, members};

/// How deep is looked; `optimizer_states / 0 / state / 17` is 4 deep.
const MOST_DEPTH: usize = 6;
/// How many objects are looked at. A graph with circles has endless paths.
const MOST_OBJECTS: usize = 1 << 20;

/// A dictionary or list of a torch file that holds tensors.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TensorGroup {
    /// Keys from the outermost dictionary, for [`super::super::WeightFile::open_nested`].
    pub keys: Vec<String>,
    /// Names of its tensors as they follow each other; positions for a list.
    pub names: Vec<String>,
    /// Whether it is a list or tuple.
    pub is_list: bool,
}

/// Every group, in the order of the file.
pub(super) fn groups(root: Object<'_>) -> Vec<TensorGroup> {
    let mut found = Vec::new();
    walk(root, &mut Vec::new(), &mut { MOST_OBJECTS }, &mut found);
    found
}

fn walk(object: Object<'_>, keys: &mut Vec<String>, budget: &mut usize, found: &mut Vec<TensorGroup>) {
    let Some(members) = members(object) else { return };
    let (tensors, others): (Vec<_>, Vec<_>) = members.into_iter().partition(|(_, value)| is_tensor(*value));
    *budget = budget.saturating_sub(1 + tensors.len() + others.len());
    if !tensors.is_empty() {
        let names = tensors.into_iter().map(|(name, _)| name).collect();
        found.push(TensorGroup { keys: keys.clone(), names, is_list: object.entries().is_none() });
    }
    if keys.len() == MOST_DEPTH {
        return;
    }
    for (name, value) in others {
        if *budget == 0 {
            return;
        }
        keys.push(name);
        walk(value, keys, budget, found);
        keys.pop();
    }
}
