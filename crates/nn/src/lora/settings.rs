//! Alpha and rank as they stand in files: the header entry of diffusers and PEFT's `adapter_config.json`.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Deserialize;
use serde_json::{Map, Value, json};

use super::{LoraError, names_layer};
use crate::weights::WeightFile;

/// Header entry of diffusers: JSON text whose keys carry the component's name.
const HEADER_ENTRY: &str = "lora_adapter_metadata";

/// What PEFT writes beside the weights of one model.
pub(super) const CONFIG_FILE: &str = "adapter_config.json";

/// The settings that change what the matrices compute.
#[derive(Debug, Default, Deserialize)]
pub(super) struct Settings {
    lora_alpha: Option<f64>,
    alpha_pattern: Option<BTreeMap<String, f64>>,
    use_rslora: Option<bool>,
    use_dora: Option<bool>,
    lora_bias: Option<bool>,
    bias: Option<String>,
}

impl Settings {
    /// From the header, else from the config file beside it, else none.
    pub(super) fn read(file: &WeightFile, component: &str) -> Result<Self, LoraError> {
        if let Some(text) = file.metadata().get(HEADER_ENTRY) {
            let all: Map<String, Value> = parse(text, file.path())?;
            let prefix = format!("{component}.");
            let ours = all.into_iter().filter_map(|(key, value)| Some((key.strip_prefix(&prefix)?.to_owned(), value)));
            let settings = serde_json::from_value(Value::Object(ours.collect()));
            return settings
                .map_err(|error| refuse(error.to_string(), file.path()))
                .and_then(|s| checked(s, file.path()));
        }
        let beside = file.path().with_file_name(CONFIG_FILE);
        match std::fs::read_to_string(&beside) {
            Ok(text) => checked(parse(&text, &beside)?, &beside),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(Self::default()),
            Err(error) => Err(refuse(error.to_string(), &beside)),
        }
    }

    /// Alpha of a module; without any setting it is the rank.
    pub(super) fn alpha(&self, module: &str, rank: usize) -> f64 {
        let special = self.alpha_pattern.iter().flatten().find(|(pattern, _)| names_layer(pattern, module));
        special.map(|(_, alpha)| *alpha).or(self.lora_alpha).unwrap_or(rank as f64)
    }
}

fn parse<T: serde::de::DeserializeOwned>(text: &str, path: &Path) -> Result<T, LoraError> {
    serde_json::from_str(text).map_err(|error| refuse(error.to_string(), path))
}

fn refuse(reason: String, path: &Path) -> LoraError {
    LoraError::Settings { reason, path: path.to_path_buf() }
}

fn checked(settings: Settings, path: &Path) -> Result<Settings, LoraError> {
    let on = |flag: Option<bool>| flag == Some(true);
    let unsupported = [
        (on(settings.use_rslora), "use_rslora (scale alpha / √rank)"),
        (on(settings.use_dora), "use_dora (magnitude vectors)"),
        (on(settings.lora_bias), "lora_bias"),
        (settings.bias.as_deref().is_some_and(|bias| bias != "none"), "trained biases"),
    ];
    if let Some((_, what)) = unsupported.iter().find(|(set, _)| *set) {
        return Err(refuse(format!("{what} is not supported"), path));
    }
    let alphas = settings.lora_alpha.iter().chain(settings.alpha_pattern.iter().flat_map(BTreeMap::values));
    if let Some(alpha) = alphas.into_iter().find(|alpha| !alpha.is_finite()) {
        return Err(refuse(format!("alpha {alpha}"), path));
    }
    Ok(settings)
}

/// Path, rank and alpha of one adapted module.
pub(super) struct Written {
    pub module: String,
    pub rank: usize,
    pub alpha: f64,
}

/// The settings of a set of modules; the first one's rank and alpha stand for all, others are listed by path.
fn describe(modules: &[Written]) -> Map<String, Value> {
    let (rank, alpha) = modules.first().map_or((1, 1.0), |first| (first.rank, first.alpha));
    let ranks = modules.iter().filter(|m| m.rank != rank).map(|m| (m.module.clone(), json!(m.rank)));
    let alphas = modules.iter().filter(|m| m.alpha != alpha).map(|m| (m.module.clone(), number(m.alpha)));
    let targets: Vec<&str> = modules.iter().map(|m| m.module.as_str()).collect();
    Map::from_iter([
        ("peft_type".to_owned(), json!("LORA")),
        ("r".to_owned(), json!(rank)),
        ("lora_alpha".to_owned(), number(alpha)),
        ("rank_pattern".to_owned(), Value::Object(ranks.collect())),
        ("alpha_pattern".to_owned(), Value::Object(alphas.collect())),
        ("target_modules".to_owned(), json!(targets)),
        ("lora_dropout".to_owned(), json!(0.0)),
        ("bias".to_owned(), json!("none")),
    ])
}

/// Other tools read whole alphas as integers.
fn number(alpha: f64) -> Value {
    if alpha.fract() == 0.0 && alpha.abs() < 1e9 { json!(alpha as i64) } else { json!(alpha) }
}

/// The header entry, name and text.
pub(super) fn header_entry(component: &str, modules: &[Written]) -> (String, String) {
    let prefixed: Map<String, Value> =
        describe(modules).into_iter().map(|(key, value)| (format!("{component}.{key}"), value)).collect();
    (HEADER_ENTRY.to_owned(), format!("{:#}", Value::Object(prefixed)))
}

/// The text of [`CONFIG_FILE`].
pub(super) fn config_text(modules: &[Written]) -> String {
    format!("{:#}\n", Value::Object(describe(modules)))
}
