//! Reading and writing adapter files.

use std::collections::BTreeMap;
use std::path::Path;

use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor, TensorData};

use super::keys::{Key, Part, read_key};
use super::settings::{self, Settings, Written};
use super::{LoraError, LoraSites, LowRank, check_known, check_new, for_each_site, push};
use crate::weights::{HostTensor, Mismatch, WeightError, WeightFile, write_safetensors, write_text};

pub use super::keys::LoraLayout;

/// Writes one adapter of a model. Factors are stored as they are; rank and alpha stand in the file's header (in
/// `adapter_config.json` for [`LoraLayout::PeftWholeModel`]). Readers that know neither take alpha = rank.
///
/// `component` is the model's name in its pipeline, such as `unet`; `notes` are further header entries.
///
/// # Errors
/// [`LoraError::Unknown`], or what [`write_safetensors`] refuses.
pub fn save<M: LoraSites + Clone>(
    model: &M,
    name: &str,
    path: &Path,
    (component, layout): (&str, LoraLayout),
    notes: &BTreeMap<String, String>,
) -> Result<(), LoraError> {
    let mut model = model.clone();
    check_known(&mut model, &[name])?;
    let (mut tensors, mut written, mut failed) = (Vec::new(), Vec::new(), None);
    for_each_site(&mut model, |site| {
        let shape = site.weight.shape();
        for adapter in site.lora.stack.iter().filter(|adapter| adapter.name() == name) {
            let names = layout.names(component, site.path);
            match [host(&names[0], &adapter.down), host(&names[1], &adapter.up)].into_iter().collect() {
                Ok(factors) => tensors.extend(shaped(names, factors, &shape)),
                Err(error) => failed = Some(error),
            }
            let (rank, alpha) = (adapter.rank(), adapter.alpha());
            written.push(Written { module: site.path.to_owned(), rank, alpha });
        }
    });
    if let Some(error) = failed {
        return Err(error.into());
    }
    let mut notes = notes.clone();
    notes.insert("format".to_owned(), "pt".to_owned());
    if layout == LoraLayout::PeftWholeModel {
        let beside = path.with_file_name(settings::CONFIG_FILE);
        write_text(&beside, &settings::config_text(&written))
            .map_err(|source| WeightError::Io { source, path: beside })?;
    } else {
        notes.extend([settings::header_entry(component, &written)]);
    }
    Ok(write_safetensors(path, &tensors, &notes)?)
}

fn host(name: &str, param: &Param<Tensor<2>>) -> Result<Vec<f32>, WeightError> {
    let readback = |error: String| WeightError::Readback { name: name.to_owned(), reason: error };
    param.val().try_into_vec_as::<f32>().map_err(|error| readback(error.to_string()))
}

/// A takes the kernel's shape, B that of a 1×1 convolution, as the layers that other tools build for them.
fn shaped(names: [String; 2], factors: Vec<Vec<f32>>, weight: &[usize]) -> Vec<(String, HostTensor)> {
    let fan_in: usize = weight[1..].iter().product();
    let shapes = |values: usize| {
        let rank = values / fan_in;
        let down = [&[rank], &weight[1..]].concat();
        let up = [&[weight[0], rank][..], &vec![1; weight.len() - 2]].concat();
        [down, up]
    };
    let [down, up] = shapes(factors.first().map_or(0, Vec::len));
    names.into_iter().zip(factors).zip([down, up]).map(|((n, f), shape)| (n, HostTensor::new(&shape, f))).collect()
}

/// Adds an adapter from a file, at its trained strength ([`super::set_weight`] changes it). The layouts of
/// [`LoraLayout`], the older one of diffusers and that of kohya's tools are told apart by their names. As after
/// [`super::attach`], the new adapter is trained and everything else frozen.
///
/// Tensors of other components of a pipeline are left alone; every other tensor must find its layer.
///
/// # Errors
/// [`LoraError::Taken`], [`LoraError::Settings`], [`WeightError::Mismatch`] with every tensor without a layer, every
/// lone factor and every wrong shape, [`WeightError::Layout`] for a file without adapters for this component.
pub fn load<M: Module + LoraSites>(mut model: M, name: &str, path: &Path, component: &str) -> Result<M, LoraError> {
    check_new(&mut model, name)?;
    let file = WeightFile::open(path)?;
    let mut sites = BTreeMap::new();
    for_each_site(&mut model, |site| {
        sites.insert(site.path.to_owned(), site.weight.shape());
    });
    let mut mismatch = Mismatch { path: Some(path.to_path_buf()), ..Mismatch::default() };
    let groups = grouped(&file, component, &sites, &mut mismatch);
    let pairs = paired(&file, groups, &sites, &mut mismatch);
    if !mismatch.is_empty() {
        return Err(WeightError::Mismatch(Box::new(mismatch)).into());
    }
    if pairs.is_empty() {
        let reason = format!("no adapter tensors for {component}");
        return Err(WeightError::Layout { reason, path: path.to_path_buf() }.into());
    }
    let settings = Settings::read(&file, component)?;
    let mut ready = BTreeMap::new();
    for (module, pair) in pairs {
        ready.insert(module.clone(), pair.read(&file, &module, &settings)?);
    }
    let mut model = model.no_grad();
    for_each_site(&mut model, |site| {
        if let Some((down, up, alpha)) = ready.remove(site.path) {
            let device = site.weight.device();
            push(site, LowRank::new(name, parameter(down, &device), parameter(up, &device), alpha));
        }
    });
    Ok(model)
}

fn parameter(values: HostTensor, device: &Device) -> Param<Tensor<2>> {
    Param::from_data(TensorData::new(values.data, values.shape), device)
}

/// Tensor names of one module.
#[derive(Default)]
struct Group {
    down: Option<String>,
    up: Option<String>,
    alpha: Option<String>,
}

/// Both factors of one module, their shapes checked.
struct Pair {
    down: String,
    up: String,
    alpha: Option<String>,
    rank: usize,
}

impl Pair {
    /// A and B as matrices, and alpha.
    fn read(self, file: &WeightFile, module: &str, set: &Settings) -> Result<(HostTensor, HostTensor, f64), LoraError> {
        let matrix = |name: &str, rows: usize| -> Result<HostTensor, WeightError> {
            let data = file.tensor(name)?.data;
            Ok(HostTensor { shape: vec![rows, data.len() / rows], data })
        };
        let down = matrix(&self.down, self.rank)?;
        let out = file.shape(&self.up).map_or(1, |shape| shape[0]);
        let up = matrix(&self.up, out)?;
        let stored = self.alpha.map(|name| file.tensor(&name)).transpose()?;
        let alpha = match stored.as_ref().map(|tensor| tensor.data.as_slice()) {
            None => set.alpha(module, self.rank),
            Some([alpha]) if alpha.is_finite() => f64::from(*alpha),
            Some(values) => {
                let reason = format!("alpha of {module} is {values:?}, not one finite number");
                return Err(LoraError::Settings { reason, path: file.path().to_path_buf() });
            }
        };
        Ok((down, up, alpha))
    }
}

fn grouped(
    file: &WeightFile,
    component: &str,
    sites: &BTreeMap<String, Vec<usize>>,
    mismatch: &mut Mismatch,
) -> BTreeMap<String, Group> {
    let flat: BTreeMap<String, &String> = sites.keys().map(|path| (path.replace('.', "_"), path)).collect();
    let mut groups: BTreeMap<String, Group> = BTreeMap::new();
    for key in file.names() {
        let found = match read_key(key, component) {
            Key::Module(module, part) if sites.contains_key(&module) => Some((module, part)),
            Key::Flat(module, part) => flat.get(&module).map(|path| ((*path).clone(), part)),
            Key::Other => continue,
            Key::Module(..) | Key::Unknown => None,
        };
        let Some((module, part)) = found else {
            mismatch.unexpected.push(key.to_owned());
            continue;
        };
        let group = groups.entry(module).or_default();
        let slot = match part {
            Part::Down => &mut group.down,
            Part::Up => &mut group.up,
            Part::Alpha => &mut group.alpha,
        };
        // Two names for one factor: the second has no place.
        if slot.replace(key.to_owned()).is_some() {
            mismatch.unexpected.push(key.to_owned());
        }
    }
    groups
}

fn paired(
    file: &WeightFile,
    groups: BTreeMap<String, Group>,
    sites: &BTreeMap<String, Vec<usize>>,
    mismatch: &mut Mismatch,
) -> BTreeMap<String, Pair> {
    let mut pairs = BTreeMap::new();
    for (module, group) in groups {
        let Some(weight) = sites.get(&module) else { continue };
        let (Some(down), Some(up)) = (&group.down, &group.up) else {
            let lone = if group.down.is_none() { "down (A)" } else { "up (B)" };
            mismatch.missing.push((format!("{module}, matrix {lone}"), Vec::new()));
            continue;
        };
        let shapes = [down, up].map(|name| file.shape(name).unwrap_or_default().to_vec());
        let rank = shapes[0].first().copied().unwrap_or(0);
        let wanted = [[&[rank], &weight[1..]].concat(), vec![weight[0], rank]];
        let wrong = [down, up].into_iter().zip(wanted).zip(&shapes);
        let wrong: Vec<_> = wrong
            .filter(|((_, wanted), found)| rank == 0 || without_unit_kernel(wanted) != without_unit_kernel(found))
            .map(|((name, wanted), found)| (name.clone(), wanted, found.clone()))
            .collect();
        if wrong.is_empty() {
            pairs.insert(module, Pair { down: down.clone(), up: up.clone(), alpha: group.alpha, rank });
        }
        mismatch.wrong_shape.extend(wrong);
    }
    pairs
}

/// A 1×1 kernel computes what a matrix does; tools differ in which they write.
fn without_unit_kernel(shape: &[usize]) -> &[usize] {
    match shape {
        [matrix @ .., 1, 1] if matrix.len() == 2 => matrix,
        all => all,
    }
}
