//! From the object graph of a torch file to named tensors.

use pickle::Object;
use safetensors::Dtype;

use super::{Storage, Storages};
use crate::weights::TorchFault;
use crate::weights::element::width;
use crate::weights::file::{Contents, Entry};

/// How often the tensors of a state dict may name the bytes of the file: weights are shared by a few names at most.
const MAX_SHARING: u64 = 16;

/// The state dict under `keys`; without them the outermost dictionary if it holds tensors, else its entry `state_dict`, else
/// the only entry that holds tensors.
pub(super) fn find<'g>(root: Object<'g>, keys: Option<&[&str]>) -> Result<Object<'g>, TorchFault> {
    let missing = |reason: String| TorchFault::StateDict(reason);
    if root.entries().is_none() {
        let found = root.describe();
        return Err(missing(format!("holds {found}; save the model's state_dict() instead of the model")));
    }
    if let Some(keys) = keys {
        let path = keys.join("/");
        let inner = keys.iter().try_fold(root, |object, key| member(object, key));
        let inner = inner.filter(|object| members(*object).is_some());
        return inner
            .ok_or_else(|| missing(format!("no dictionary or list under {path}; there are {}", key_list(root))));
    }
    if holds_tensors(root) {
        return Ok(root);
    }
    let entries = root.entries().unwrap_or_default();
    let named = |(key, value): &(Object<'g>, Object<'g>)| Some((key.text()?, *value));
    let inner: Vec<_> = entries.iter().filter_map(named).filter(|(_, value)| holds_tensors(*value)).collect();
    match (inner.iter().rev().find(|(key, _)| *key == "state_dict"), inner.as_slice()) {
        (Some((_, chosen)), _) | (None, [(_, chosen)]) => Ok(*chosen),
        (None, []) => Err(missing(format!("no tensors; there are {}", key_list(root)))),
        (None, several) => {
            let names: Vec<_> = several.iter().map(|(key, _)| *key).collect();
            Err(missing(format!("several state dicts, name one of {}", names.join(", "))))
        }
    }
}

/// What a dictionary holds under text keys, numbers and classes (by name), and a list under its positions.
pub(super) fn members(object: Object<'_>) -> Option<Vec<(String, Object<'_>)>> {
    let Some(entries) = object.entries() else {
        let items = object.items()?.into_iter().enumerate();
        return Some(items.map(|(position, item)| (position.to_string(), item)).collect());
    };
    let label = |key: Object<'_>| match (key.text(), key.integer(), key.global()) {
        (Some(text), ..) => Some(text.to_owned()),
        (_, Some(number), _) => Some(number.to_string()),
        (.., Some((module, name))) => Some(format!("{module}.{name}")),
        _ => None,
    };
    Some(entries.into_iter().filter_map(|(key, value)| Some((label(key)?, value))).collect())
}

fn member<'g>(object: Object<'g>, key: &str) -> Option<Object<'g>> {
    // Python keeps the last of equal keys.
    members(object)?.into_iter().rev().find(|(label, _)| label == key).map(|(_, value)| value)
}

/// The text keys of a dictionary, the first ten of them.
fn key_list(dictionary: Object<'_>) -> String {
    let entries = dictionary.entries().unwrap_or_default();
    let keys: Vec<&str> = entries.iter().filter_map(|(key, _)| key.text()).take(10).collect();
    if keys.is_empty() { "no names".to_owned() } else { keys.join(", ") }
}

pub(super) fn is_tensor(object: Object<'_>) -> bool {
    Rebuild::of(object).is_some()
}

fn holds_tensors(object: Object<'_>) -> bool {
    object.entries().is_some_and(|entries| entries.iter().any(|(_, value)| Rebuild::of(*value).is_some()))
}

/// Every dense tensor of a state dict.
pub(super) fn tensors(state_dict: Object<'_>, storages: &Storages) -> Result<Contents, TorchFault> {
    let mut contents = Contents::default();
    let mut budget = storages.values().map(|storage| storage.bytes).sum::<u64>().saturating_mul(MAX_SHARING);
    for (name, value) in members(state_dict).unwrap_or_default() {
        let fault = |reason: String| TorchFault::Tensor { name: name.clone(), reason };
        let Some(rebuild) = Rebuild::of(value) else {
            contents.others.push(name);
            continue;
        };
        let entry = rebuild.entry(storages).map_err(fault)?;
        let bytes = entry.span as u64 * width(entry.dtype) as u64;
        budget = budget.checked_sub(bytes).ok_or_else(|| {
            fault(format!("with it the tensors name more than {MAX_SHARING} times the bytes of the file"))
        })?;
        if contents.tensors.contains_key(&name) {
            return Err(fault("the name is given twice".to_owned()));
        }
        contents.order.push(name.clone());
        contents.tensors.insert(name, entry);
    }
    Ok(contents)
}

/// A persistent id: `("storage", type, key, device, elements, …)`.
#[derive(Debug)]
pub(super) struct StorageId<'g> {
    pub key: &'g str,
    /// Element type, unless the storage is untyped and counts bytes.
    dtype: Option<Dtype>,
    /// Bytes of an element.
    pub width: usize,
    elements: u64,
    /// Part of a larger storage (torch 0.3 and before).
    is_view: bool,
}

impl<'g> StorageId<'g> {
    pub fn read(id: Object<'g>) -> Option<Self> {
        let items = id.items()?;
        let [tag, class, key, _device, elements, rest @ ..] = items.as_slice() else { return None };
        if tag.text() != Some("storage") {
            return None;
        }
        let dtype = match class.global()? {
            ("torch.storage" | "torch", "UntypedStorage") => None,
            ("torch" | "torch.cuda", name) => Some(storage_dtype(name)?),
            _ => return None,
        };
        let is_view = rest.iter().any(|view| !view.is_none());
        let elements = u64::try_from(elements.integer()?).ok()?;
        Some(Self { key: key.text()?, dtype, width: dtype.map_or(1, width), elements, is_view })
    }
}

fn storage_dtype(name: &str) -> Option<Dtype> {
    Some(match name {
        "DoubleStorage" => Dtype::F64,
        "FloatStorage" => Dtype::F32,
        "HalfStorage" => Dtype::F16,
        "BFloat16Storage" => Dtype::BF16,
        "LongStorage" => Dtype::I64,
        "IntStorage" => Dtype::I32,
        "ShortStorage" => Dtype::I16,
        "CharStorage" => Dtype::I8,
        "ByteStorage" => Dtype::U8,
        "BoolStorage" => Dtype::BOOL,
        _ => return None,
    })
}

fn dtype_named(name: &str) -> Option<Dtype> {
    Some(match name {
        "float64" => Dtype::F64,
        "float32" => Dtype::F32,
        "float16" => Dtype::F16,
        "bfloat16" => Dtype::BF16,
        "int64" => Dtype::I64,
        "int32" => Dtype::I32,
        "int16" => Dtype::I16,
        "int8" => Dtype::I8,
        "uint8" => Dtype::U8,
        "bool" => Dtype::BOOL,
        _ => return None,
    })
}

/// The record of a call that would have rebuilt a dense tensor of a known element type.
struct Rebuild<'g> {
    storage: StorageId<'g>,
    dtype: Dtype,
    offset: Object<'g>,
    size: Object<'g>,
    stride: Object<'g>,
}

impl<'g> Rebuild<'g> {
    fn of(object: Object<'g>) -> Option<Self> {
        let ((module, name), arguments) = object.call()?;
        match (module, name) {
            ("torch._utils", "_rebuild_tensor" | "_rebuild_tensor_v2" | "_rebuild_tensor_v3") => {}
            // A parameter wraps a tensor; the wrapped one cannot be a parameter again.
            ("torch._utils", "_rebuild_parameter" | "_rebuild_parameter_with_state") => {
                let inner = *arguments.first()?;
                let is_parameter = inner.call().is_some_and(|((_, name), _)| name.starts_with("_rebuild_parameter"));
                return if is_parameter { None } else { Self::of(inner) };
            }
            _ => return None,
        }
        let [id, offset, size, stride, rest @ ..] = arguments.as_slice() else { return None };
        let storage = StorageId::read(id.persistent_id()?)?;
        let dtype = match (storage.dtype, rest.get(2).and_then(|dtype| dtype.global())) {
            (Some(dtype), _) => dtype,
            (None, Some(("torch", name))) => dtype_named(name)?,
            _ => return None,
        };
        Some(Self { storage, dtype, offset: *offset, size: *size, stride: *stride })
    }

    /// Checks every number against the storage that is really there.
    fn entry(&self, storages: &Storages) -> Result<Entry, String> {
        if self.storage.is_view {
            return Err("its storage is part of another one (torch 0.3); save it again with a newer torch".to_owned());
        }
        let key = self.storage.key;
        let Storage { start, bytes } = *storages.get(key).ok_or_else(|| format!("no storage {key}"))?;
        let announced = self.storage.elements.checked_mul(self.storage.width as u64);
        if announced.is_none_or(|announced| announced > bytes) {
            return Err(format!("storage {key} has {bytes} bytes, {} elements announced", self.storage.elements));
        }
        let (shape, strides) = (whole_numbers(self.size, "size")?, whole_numbers(self.stride, "stride")?);
        if shape.len() != strides.len() {
            return Err(format!("{} sizes and {} strides", shape.len(), strides.len()));
        }
        let width = width(self.dtype) as u64;
        let offset = self.offset.integer().and_then(|offset| u64::try_from(offset).ok());
        let first = offset.and_then(|offset| offset.checked_mul(width)).ok_or("its offset is no whole number")?;
        let extent = Extent::of(&shape, &strides).ok_or_else(|| format!("size {shape:?} overflows"))?;
        let fits = |elements: usize, from: u64| {
            (elements as u64)
                .checked_mul(width)
                .and_then(|length| length.checked_add(from))
                .is_some_and(|end| end <= bytes)
        };
        if !fits(extent.span, first) {
            return Err(format!("size {shape:?}, strides {strides:?} leave the {bytes} bytes of storage {key}"));
        }
        // Strides of zero repeat values; a few bytes would become any amount of memory.
        if !fits(extent.count, 0) {
            return Err(format!("size {shape:?} holds more than the {bytes} bytes of storage {key}"));
        }
        let strides = (!extent.dense).then_some(strides);
        Ok(Entry { dtype: self.dtype, shape, start: start + first, span: extent.span, strides })
    }
}

/// The elements that a shape with strides touches.
struct Extent {
    count: usize,
    /// From the first element to the last.
    span: usize,
    /// Row-major without gaps.
    dense: bool,
}

impl Extent {
    fn of(shape: &[usize], strides: &[usize]) -> Option<Self> {
        let count = shape.iter().try_fold(1_usize, |count, length| count.checked_mul(*length))?;
        if count == 0 {
            return Some(Self { count, span: 0, dense: true });
        }
        let (mut last, mut row, mut dense) = (0_usize, 1_usize, true);
        for (&length, &stride) in shape.iter().zip(strides).rev() {
            last = last.checked_add((length - 1).checked_mul(stride)?)?;
            // An axis of one element is never stepped along.
            dense &= length == 1 || stride == row;
            row *= length;
        }
        Some(Self { count, span: last.checked_add(1)?, dense })
    }
}

fn whole_numbers(object: Object<'_>, what: &str) -> Result<Vec<usize>, String> {
    let items = object.items().ok_or_else(|| format!("its {what} is {}", object.describe()))?;
    let whole = |item: &Object<'_>| item.integer().and_then(|value| usize::try_from(value).ok());
    items.iter().map(whole).collect::<Option<_>>().ok_or_else(|| format!("its {what} is not of whole numbers"))
}
