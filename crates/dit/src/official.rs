//! Names of the public DiT's parameters for ours, one to one, where both have the part.

/// Our path segments and the public ones, applied in order to a whole path.
const RENAMES: [(&str, &str); 13] = [
    ("timestep.expand.", "t_embedder.mlp.0."),
    ("timestep.mix.", "t_embedder.mlp.2."),
    ("label.table", "y_embedder.embedding_table.weight"),
    ("last.modulation.", "final_layer.adaLN_modulation.1."),
    ("last.linear.", "final_layer.linear."),
    (".modulation.", ".adaLN_modulation.1."),
    (".qkv.", ".attn.qkv."),
    (".out.", ".attn.proj."),
    (".expand.", ".mlp.fc1."),
    (".contract.", ".mlp.fc2."),
    ("final_layer.adaLN_modulation.1.1.", "final_layer.adaLN_modulation.1."),
    ("t_embedder.mlp.0.mlp.fc1.", "t_embedder.mlp.0."),
    ("patch.", "x_embedder.proj."),
];

/// The public name of one of our parameter paths.
pub fn official_name(path: &str) -> String {
    RENAMES.iter().fold(path.to_owned(), |name, (ours, theirs)| name.replace(ours, theirs))
}
