//! Experiment files: TOML, `--set` overrides, strict at every level.

use std::path::Path;

use anyhow::{Context, bail};
use serde::de::DeserializeOwned;
use toml::{Table, Value};

/// Reads a TOML file, applies `key.path=value` overrides and checks it against `T`, which refuses unknown fields.
///
/// # Errors
/// Names the file and the offending key.
pub fn load<T: DeserializeOwned>(path: &Path, overrides: &[String]) -> anyhow::Result<T> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read the config {}", path.display()))?;
    parse(&text, overrides).with_context(|| format!("in the config {}", path.display()))
}

/// As [`load`], from text.
///
/// # Errors
/// Names the offending key.
pub fn parse<T: DeserializeOwned>(text: &str, overrides: &[String]) -> anyhow::Result<T> {
    if overrides.is_empty() {
        // Straight from the text, so that complaints show the line.
        return Ok(toml::from_str(text)?);
    }
    let mut table: Table = toml::from_str(text)?;
    for entry in overrides {
        set(&mut table, entry)?;
    }
    // Through text once more, so that complaints name the path of the key.
    Ok(toml::from_str(&toml::to_string(&table)?)?)
}

/// Applies one `a.b.c=value`; the value is TOML, or a plain word that becomes a string. `a.0.b` indexes arrays of tables.
fn set(table: &mut Table, entry: &str) -> anyhow::Result<()> {
    let Some((path, text)) = entry.split_once('=') else {
        bail!("--set {entry}: write it as key.path=value");
    };
    let value = parse_value(text.trim());
    let keys: Vec<&str> = path.trim().split('.').collect();
    let Some((last, parents)) = keys.split_last() else { bail!("--set {entry}: the key is empty") };
    let mut root = Value::Table(std::mem::take(table));
    let mut here = &mut root;
    for key in parents {
        here = descend(here, key).with_context(|| format!("--set {entry}"))?;
    }
    match here {
        Value::Table(inner) => {
            inner.insert((*last).to_owned(), value);
        }
        Value::Array(list) => {
            let index: usize = last.parse().with_context(|| format!("--set {entry}: {last} indexes a list"))?;
            *list.get_mut(index).with_context(|| format!("--set {entry}: the list has no entry {index}"))? = value;
        }
        _ => bail!("--set {entry}: {} is a plain value, not a table", parents.join(".")),
    }
    if let Value::Table(done) = root {
        *table = done;
    }
    Ok(())
}

fn descend<'a>(value: &'a mut Value, key: &str) -> anyhow::Result<&'a mut Value> {
    match value {
        Value::Table(table) => Ok(table.entry(key).or_insert_with(|| Value::Table(Table::new()))),
        Value::Array(list) => {
            let index: usize = key.parse().with_context(|| format!("{key} must be an index into a list"))?;
            list.get_mut(index).with_context(|| format!("the list has no entry {index}"))
        }
        _ => bail!("{key} lies inside a plain value"),
    }
}

fn parse_value(text: &str) -> Value {
    let wrapped = format!("value = {text}");
    toml::from_str::<Table>(&wrapped)
        .ok()
        .and_then(|mut table| table.remove("value"))
        .unwrap_or_else(|| Value::String(text.to_owned()))
}

/// Lays `over` on `base`: tables merge key by key, everything else is replaced.
pub fn merge(base: Value, over: Value) -> Value {
    match (base, over) {
        (Value::Table(mut base), Value::Table(over)) => {
            for (key, value) in over {
                let merged = match base.remove(&key) {
                    Some(old) => merge(old, value),
                    None => value,
                };
                base.insert(key, merged);
            }
            Value::Table(base)
        }
        (_, over) => over,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(serde::Deserialize, Debug)]
    #[serde(deny_unknown_fields)]
    struct Inner {
        rate: f64,
        name: String,
    }

    #[derive(serde::Deserialize, Debug)]
    #[serde(deny_unknown_fields)]
    struct Outer {
        seed: u64,
        inner: Vec<Inner>,
    }

    const TEXT: &str = "seed = 1\n[[inner]]\nrate = 0.5\nname = \"a\"\n";

    #[test]
    fn overrides_reach_any_depth() {
        let set = ["seed=7".to_owned(), "inner.0.rate = 1e-4".to_owned(), "inner.0.name=plain word".to_owned()];
        let got: Outer = parse(TEXT, &set).unwrap();
        assert_eq!((got.seed, got.inner[0].rate, got.inner[0].name.as_str()), (7, 1e-4, "plain word"));
    }

    #[test]
    fn mistakes_are_named() {
        for (set, want) in [
            ("sed=7", "sed"),
            ("inner.3.rate=1", "no entry 3"),
            ("seed", "key.path=value"),
            ("seed.x=1", "plain value"),
        ] {
            let error = format!("{:#}", parse::<Outer>(TEXT, &[set.to_owned()]).unwrap_err());
            assert!(error.contains(want), "{set}: {error}");
        }
        let error = format!("{:#}", parse::<Outer>("seed = 1\ninnr = []\n", &[]).unwrap_err());
        assert!(error.contains("innr"), "{error}");
    }
}
