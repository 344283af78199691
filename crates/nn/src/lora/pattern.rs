//! Which paths a target names.

/// Whether a pattern names a layer. It holds for the whole path or for its end after a dot; `*` stands for any run of
/// characters, dots included.
///
/// `to_q` names every layer called so, `attn1.to_*` four of them in each block, `down_blocks.*.to_out.0` those of one
/// half.
#[must_use]
pub fn names_layer(pattern: &str, path: &str) -> bool {
    let ends = path.match_indices('.').map(|(dot, _)| &path[dot + 1..]);
    std::iter::once(path).chain(ends).any(|end| matches_glob(pattern, end))
}

fn matches_glob(pattern: &str, text: &str) -> bool {
    let mut parts = pattern.split('*');
    let Some(mut rest) = parts.next().and_then(|first| text.strip_prefix(first)) else { return false };
    let mut parts = parts.peekable();
    if parts.peek().is_none() {
        return rest.is_empty();
    }
    while let Some(part) = parts.next() {
        if parts.peek().is_none() {
            return rest.ends_with(part);
        }
        // The leftmost place leaves most for the parts behind it.
        let Some(at) = rest.find(part) else { return false };
        rest = &rest[at + part.len()..];
    }
    false
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whole_paths_ends_and_stars() {
        let path = "down_blocks.0.attentions.1.transformer_blocks.0.attn1.to_out.0";
        for pattern in [path, "to_out.0", "attn1.to_*", "attn*.to_out.*", "down_blocks.*.to_out.0", "*", "*.0", "0"] {
            assert!(names_layer(pattern, path), "{pattern}");
        }
        for pattern in ["to_out", "out.0", "up_blocks.*", "attn2.to_*", "attn1*to_q", "", "down_blocks", "*a*z*"] {
            assert!(!names_layer(pattern, path), "{pattern}");
        }
        assert!(names_layer("a*b*a", "abba") && !names_layer("ab*ba", "aba"));
    }
}
