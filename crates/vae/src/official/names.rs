//! Names of the public checkpoint's parameters for ours, one to one.

/// Our path segments and the official ones, applied in order to a whole path.
const RENAMES: [(&str, &str); 37] = [
    ("encoder.image.patch.", "encoder.image.to_patch.proj.0."),
    ("encoder.scene.pillar_query", "encoder.scene.scene_embedding.weight"),
    ("decoder.scene.ray_query", "decoder.scene.frustum_embedding.weight"),
    ("decoder.scene.out.", "decoder.scene.proj."),
    ("encoder.state.squeeze.", "encoder.state.to_state.proj.0."),
    ("encoder.state.patch.", "encoder.state.to_state.proj.3."),
    ("decoder.state.unpatch.", "decoder.state.to_scene.proj.1."),
    ("decoder.state.expand.", "decoder.state.to_scene.proj.4."),
    ("decoder.image.pixels.", "decoder.image.to_pixel.proj.1."),
    ("pyramid.fine_up_1.deconv.", "fpn.fpn1.0."),
    ("pyramid.fine_up_1.norm.", "fpn.fpn1.1."),
    ("pyramid.fine_up_2.deconv.", "fpn.fpn1.3."),
    ("pyramid.fine_up_2.norm.", "fpn.fpn1.4."),
    ("encoder.scene.pyramid.fine.", "encoder.scene.fpn.fpn1.head6."),
    ("pyramid.middle_up.deconv.", "fpn.fpn2.0."),
    ("pyramid.middle_up.norm.", "fpn.fpn2.1."),
    ("pyramid.coarse_down_1.conv.", "fpn.fpn1.0."),
    ("pyramid.coarse_down_1.norm.", "fpn.fpn1.1."),
    ("pyramid.coarse_down_2.conv.", "fpn.fpn1.3."),
    ("pyramid.coarse_down_2.norm.", "fpn.fpn1.4."),
    ("decoder.scene.pyramid.coarse.", "decoder.scene.fpn.fpn1.head6."),
    ("pyramid.middle_down.conv.", "fpn.fpn2.0."),
    ("pyramid.middle_down.norm.", "fpn.fpn2.1."),
    ("pyramid.middle.", "fpn.fpn2.head3."),
    ("encoder.scene.pyramid.coarse_norm.", "encoder.scene.fpn.fpn3.0."),
    ("encoder.scene.pyramid.coarse.", "encoder.scene.fpn.fpn3.head2."),
    ("decoder.scene.pyramid.fine_norm.", "decoder.scene.fpn.fpn3.0."),
    ("decoder.scene.pyramid.fine.", "decoder.scene.fpn.fpn3.head2."),
    ("attention.query_norm.weight", "attn.norm.query_norm.scale"),
    ("attention.key_norm.weight", "attn.norm.key_norm.scale"),
    ("attention.qkv.", "attn.c_attn."),
    ("mlp.expand.", "mlp.c_fc."),
    ("mlp.contract.", "mlp.c_proj."),
    ("norm_query.", "ln_1."),
    ("norm_value.", "ln_v."),
    ("norm_mlp.", "ln_2."),
    ("stack.", "transformer."),
];

/// The official name of one of our parameter paths.
pub fn official_name(path: &str) -> String {
    let mut name = RENAMES.iter().fold(path.to_owned(), |name, (ours, theirs)| name.replace(ours, theirs));
    let is_scene = name.contains(".scene.");
    // The final norm and the blocks of the scene stacks stand one level deeper in the official names.
    for part in ["blocks.", "norm.weight"] {
        for side in ["encoder.scene.", "decoder.scene."] {
            if let Some(rest) = name.strip_prefix(side).filter(|rest| rest.starts_with(part)) {
                name = format!("{side}transformer.{rest}");
            }
        }
    }
    let attention_out = if is_scene { "attn.proj." } else { "attn.c_proj." };
    name = name.replace("attention.out.", attention_out).replace("attention.", "attn.");
    name = name.replace("norm_1.", "ln_1.").replace("norm_2.", "ln_2.");
    head_positions(name)
}

/// `headN.{pointwise, norm, conv}` are the positions N, N+1 and N+3 of an official pyramid list.
fn head_positions(name: String) -> String {
    for (head, first) in [("head6.", 6), ("head3.", 3), ("head2.", 2)] {
        for (layer, step) in [("pointwise.", 0), ("norm.", 1), ("conv.", 3)] {
            let ours = format!("{head}{layer}");
            if name.contains(&ours) {
                return name.replace(&ours, &format!("{}.", first + step));
            }
        }
    }
    name
}

/// The official shape of one of our parameters: convolutions over single pixels or voxels are matrices here.
pub fn official_shape(path: &str, ours: &[usize]) -> Vec<usize> {
    let pointwise_axes = match path {
        "encoder.state.squeeze.weight" | "decoder.state.expand.weight" => 3,
        _ if path.starts_with("encoder.scene.pyramid.") && path.ends_with(".pointwise.weight") => 2,
        _ if path.starts_with("decoder.scene.pyramid.") && path.ends_with(".pointwise.weight") => 3,
        _ => 0,
    };
    [ours, &[1, 1, 1][..pointwise_axes]].concat()
}

/// Whether an official name belongs to none of our parameters by design: tables that follow from the config, colours of diagrams,
/// networks of losses and metrics.
pub fn is_ignored(name: &str) -> bool {
    const PREFIXES: [&str; 3] = ["evaluation.", "matcher.", "loss."];
    const COLOURS: [&str; 4] = ["img_color", "scn_color", "stt_color", "cond_color"];
    const TABLES: [&str; 3] = [".scene_3d", ".frustum_3d", ".pos_embedding.inv_freq"];
    PREFIXES.iter().any(|prefix| name.starts_with(prefix))
        || COLOURS.contains(&name)
        || TABLES.iter().any(|table| name.ends_with(table))
}
