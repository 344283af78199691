//! Statistics files in place of pictures.

use std::collections::BTreeMap;
use std::path::Path;

use metrics::FrameRule;

use super::super::common::{UsageError, say};
use super::{EvaluateArgs, code_version};
use crate::evaluate::{FeatureStream, Pass, PictureSource, Replaced, SavedStatistics, Side};

/// The one network whose statistics a file can hold.
fn only_stream(pass: &Pass) -> anyhow::Result<&FeatureStream> {
    match pass.streams.as_slice() {
        [one] => Ok(one),
        [] => Err(UsageError::of("no chosen protocol has features; choose one with --protocol, for example fid/plain")),
        _ => Err(UsageError::of("a statistics file holds one kind of features; choose one protocol with --protocol")),
    }
}

fn belongs_to(stream: &FeatureStream, args: &EvaluateArgs) -> BTreeMap<String, String> {
    let size = args.size.map_or_else(|| "as stored".to_owned(), |[height, width]| format!("{height}x{width}"));
    let frames = if stream.protocol.frames == FrameRule::KeyFrames { "key frames" } else { "all" };
    let entries = [
        ("protocol", stream.protocol.name.clone()),
        ("network", stream.loaded.weights.network.clone()),
        ("weights_sha256", stream.loaded.weights.sha256.clone()),
        ("size", size),
        ("frames", frames.to_owned()),
    ];
    entries.map(|(key, value)| (key.to_owned(), value)).into()
}

pub(super) fn replaced(args: &EvaluateArgs, pass: &Pass) -> anyhow::Result<Replaced> {
    let Some(path) = &args.real_stats else { return Ok(Replaced::new()) };
    let saved = SavedStatistics::read(path)?;
    saved.must_fit(&belongs_to(only_stream(pass)?, args), path)?;
    Ok(Replaced::from([(Side::Real, saved.statistics)]))
}

pub(super) fn save_statistics(
    path: &Path,
    args: &EvaluateArgs,
    pass: &Pass,
    source: &dyn PictureSource,
    frames_sha256: &str,
) -> anyhow::Result<()> {
    let stream = only_stream(pass)?;
    let statistics = stream.side(Side::Generated).moments.statistics(&source.describe())?;
    let mut metadata = belongs_to(stream, args);
    let further = [
        ("dataset", source.describe()),
        ("frames_sha256", frames_sha256.to_owned()),
        ("seed", args.seed.to_string()),
        ("code", code_version()),
    ];
    metadata.extend(further.map(|(key, value)| (key.to_owned(), value)));
    let count = statistics.count.unwrap_or(0);
    SavedStatistics { statistics, metadata }.write(path)?;
    say(format_args!("statistics of {count} samples written to {}", path.display()))
}
