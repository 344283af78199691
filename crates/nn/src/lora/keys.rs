//! Tensor names of adapter files, in the layouts that are in use.
//!
//! | layout | names |
//! |---|---|
//! | PEFT in a diffusers file | `unet.<module>.lora_A.weight`, `unet.<module>.lora_B.weight` |
//! | PEFT, one model | `base_model.model.<module>.lora_A.weight`, … |
//! | diffusers | `unet.<module>.lora.down.weight`, `unet.<module>.lora.up.weight` |
//! | diffusers before 0.20 | `<block>.attn1.processor.to_q_lora.down.weight`, … |
//! | kohya | `lora_unet_<module with underscores>.lora_down.weight`, …, `….alpha` |

/// What a tensor is to its module.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Part {
    Down,
    Up,
    Alpha,
}

/// Whose tensor it is.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Key {
    /// A module of the component, by its path.
    Module(String, Part),
    /// A module of the component, its dots written as underscores.
    Flat(String, Part),
    /// Another component of the same pipeline.
    Other,
    /// No adapter tensor.
    Unknown,
}

/// Names of a pipeline's components, and what kohya's tools write for them.
const COMPONENTS: [(&str, &str); 4] = [
    ("unet", "lora_unet_"),
    ("text_encoder", "lora_te_"),
    ("text_encoder_2", "lora_te2_"),
    ("transformer", "lora_transformer_"),
];

const WHOLE_MODEL: &str = "base_model.model.";

const ENDINGS: [(&str, Part); 11] = [
    (".lora_A.weight", Part::Down),
    (".lora_B.weight", Part::Up),
    (".lora.down.weight", Part::Down),
    (".lora.up.weight", Part::Up),
    (".lora_linear_layer.down.weight", Part::Down),
    (".lora_linear_layer.up.weight", Part::Up),
    (".lora_down.weight", Part::Down),
    (".lora_up.weight", Part::Up),
    ("_lora.down.weight", Part::Down),
    ("_lora.up.weight", Part::Up),
    (".alpha", Part::Alpha),
];

/// Reads one tensor name of a file that is loaded into `component`.
pub(super) fn read_key(key: &str, component: &str) -> Key {
    let ending = ENDINGS.iter().find_map(|(ending, part)| Some((key.strip_suffix(ending)?, *part)));
    let Some((stem, part)) = ending else { return Key::Unknown };
    let stem = stem.strip_prefix(WHOLE_MODEL).unwrap_or(stem);
    for (name, prefix) in COMPONENTS {
        if let Some(module) = stem.strip_prefix(prefix) {
            return if name == component { Key::Flat(module.to_owned(), part) } else { Key::Other };
        }
    }
    let module = match stem.split_once('.') {
        Some((first, rest)) if first == component => rest,
        Some((first, _)) if COMPONENTS.iter().any(|(name, _)| *name == first) => return Key::Other,
        _ => stem,
    };
    Key::Module(module.replace(".processor.to_out", ".to_out.0").replace(".processor.", "."), part)
}

/// The layouts this crate writes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LoraLayout {
    /// `unet.<module>.lora.down.weight`, as the usual training scripts write `pytorch_lora_weights.safetensors`.
    Diffusers,
    /// `unet.<module>.lora_A.weight`, as newer versions of diffusers write the same file.
    Peft,
    /// `base_model.model.<module>.lora_A.weight` with `adapter_config.json` beside the file.
    PeftWholeModel,
}

impl LoraLayout {
    /// Names of A and B of a module.
    pub(super) fn names(self, component: &str, module: &str) -> [String; 2] {
        match self {
            Self::Diffusers => ["down", "up"].map(|end| format!("{component}.{module}.lora.{end}.weight")),
            Self::Peft => ["A", "B"].map(|end| format!("{component}.{module}.lora_{end}.weight")),
            Self::PeftWholeModel => ["A", "B"].map(|end| format!("{WHOLE_MODEL}{module}.lora_{end}.weight")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_layout_is_read() {
        let module = "mid_block.attentions.0.transformer_blocks.0.attn1.to_out.0";
        let ours = |part| Key::Module(module.to_owned(), part);
        for layout in [LoraLayout::Diffusers, LoraLayout::Peft, LoraLayout::PeftWholeModel] {
            let [down, up] = layout.names("unet", module);
            assert_eq!([read_key(&down, "unet"), read_key(&up, "unet")], [ours(Part::Down), ours(Part::Up)], "{down}");
        }
        let old = "mid_block.attentions.0.transformer_blocks.0.attn1.processor.to_out_lora.up.weight";
        assert_eq!(read_key(old, "unet"), ours(Part::Up));
        let flat = module.replace('.', "_");
        assert_eq!(read_key(&format!("lora_unet_{flat}.alpha"), "unet"), Key::Flat(flat.clone(), Part::Alpha));
        assert_eq!(read_key("lora_te_text_model_x.lora_up.weight", "unet"), Key::Other);
        assert_eq!(read_key("text_encoder.x.lora_A.weight", "unet"), Key::Other);
        assert_eq!(read_key("unet.x.weight", "unet"), Key::Unknown);
    }
}
