//! Token ids against the reference, files of tokenizers.

use std::path::Path;

use serde_json::Value;
use stable_diffusion::text::{
    BytePairs, ClipTokenizer, Padding, TextCleaning, TextError, Tokenizer, WordTokenizer, load_tokenizer,
};

use super::reference::{END, golden, integers, json, table};

struct Cases {
    entries: Vec<Value>,
    texts: Vec<String>,
    file: std::path::PathBuf,
}

impl Cases {
    fn open() -> Option<Self> {
        let folder = golden("clip_tokenizer")?;
        let entries = json(&folder.join("cases.json")).as_array().unwrap().clone();
        let texts = entries.iter().map(|case| case["text"].as_str().unwrap().to_owned()).collect();
        Some(Self { entries, texts, file: folder.join("io.safetensors") })
    }

    fn ids(&self, name: &str) -> Vec<Vec<u32>> {
        let (shape, ids) = integers(&self.file, name);
        assert_eq!(shape, [60, 77]);
        ids.chunks(77).map(<[u32]>::to_vec).collect()
    }
}

fn rows(tokenizer: &ClipTokenizer, texts: &[String]) -> Vec<Vec<u32>> {
    tokenizer.tokenize(texts).ids().chunks(77).map(<[u32]>::to_vec).collect()
}

#[test]
fn all_texts_have_the_ids_of_the_pipelines() {
    let (Some(cases), Some(pairs)) = (Cases::open(), table()) else { return };
    let tokenizer = ClipTokenizer::new(pairs, TextCleaning::Transformers, Padding::EndToken);
    let want = cases.ids("ids_hf_pad_eos");
    for ((text, got), want) in cases.texts.iter().zip(rows(&tokenizer, &cases.texts)).zip(&want) {
        assert_eq!(&got, want, "{text:?}");
    }
    // Begin and end are counted.
    let lengths = tokenizer.tokenize(&cases.texts).lengths().to_vec();
    for ((case, length), row) in cases.entries.iter().zip(lengths).zip(&want) {
        assert_eq!(length, row.iter().position(|id| *id == END).unwrap() + 1);
        assert!(case["same_in_hf"] == false || case["length"] == length, "{case}");
    }
}

#[test]
fn all_texts_have_the_ids_of_the_training() {
    let (Some(cases), Some(pairs)) = (Cases::open(), table()) else { return };
    let pipelines = cases.ids("ids_hf_pad_eos");
    for (padding, name) in [(Padding::EndToken, "ids_pad_eos"), (Padding::Zero, "ids_pad_zero")] {
        let tokenizer = ClipTokenizer::new(pairs.clone(), TextCleaning::OpenClip, padding);
        let want = cases.ids(name);
        let mut repaired = 0;
        for (i, got) in rows(&tokenizer, &cases.texts).into_iter().enumerate() {
            if cases.entries[i]["changed_by_ftfy"] == true {
                // Texts whose repair is not ours have the ids of the pipelines, padding apart.
                let pad = |id: &u32| if padding == Padding::Zero && *id == 0 { END } else { *id };
                assert_eq!(got.iter().map(pad).collect::<Vec<_>>(), pipelines[i], "{:?}", cases.texts[i]);
                repaired += 1;
            } else {
                assert_eq!(got, want[i], "{:?}", cases.texts[i]);
            }
        }
        assert_eq!(repaired, 4);
    }
}

#[test]
fn ids_decode_to_the_text() {
    let (Some(cases), Some(pairs)) = (Cases::open(), table()) else { return };
    assert_eq!(pairs.vocabulary_size(), 49_408);
    assert_eq!(pairs.marks(), [49_406, END]);
    for (case, ids) in cases.entries.iter().zip(cases.ids("ids_pad_eos")) {
        assert_eq!(pairs.decode(&ids).trim(), case["decoded"].as_str().unwrap().trim());
    }
    // A mark inside a text is the mark; everything behind it is padding to who looks for the first end.
    let tokenizer = ClipTokenizer::new(pairs, TextCleaning::Transformers, Padding::EndToken);
    let batch = tokenizer.tokenize(&["a <|endoftext|> b"]);
    assert_eq!((batch.ids()[2], batch.lengths()), (END, [3].as_slice()));
}

#[test]
fn words_need_no_file() {
    let tokenizer = Tokenizer::Words(WordTokenizer::new(6));
    assert_eq!((tokenizer.vocabulary_size(), tokenizer.context()), (8195, 6));
    let batch = tokenizer.tokenize(&["A  \n b", "", "foobar, FooBar a b a"]);
    let (begin, end, pad) = (8192, 8193, 8194);
    // The low bits of published FNV-1a values: af63dc4c8601ec8c, af63df4c8601f1a5, 85944171f73967e8.
    let (a, b, foobar) = (0xec8c & 8191, 0xf1a5 & 8191, 0x67e8 & 8191);
    let comma = batch.ids()[14];
    let expected =
        [[begin, a, b, end, pad, pad], [begin, end, pad, pad, pad, pad], [begin, foobar, comma, foobar, a, end]];
    assert_eq!(batch.ids(), expected.concat());
    assert!(![a, b, foobar].contains(&comma) && comma < begin);
    assert_eq!(batch.lengths(), [4, 2, 6]);
    let mask: Vec<bool> = batch.attention_mask(&super::reference::device()).into_data().iter::<bool>().collect();
    assert_eq!(mask, expected.concat().iter().map(|id| *id != pad).collect::<Vec<_>>());
}

/// A tokenizer's folder with a vocabulary of bytes, marks and the merge "a b</w>".
fn small_folder(folder: &Path) {
    let printable: Vec<char> = ('!'..='~').chain('¡'..='¬').chain('®'..='ÿ').collect();
    let others = ('\u{100}'..).take(256 - printable.len());
    let bytes: Vec<String> = printable.iter().copied().chain(others).map(String::from).collect();
    let ends = bytes.iter().map(|byte| format!("{byte}</w>"));
    let more = ["ab</w>", "<|startoftext|>", "<|endoftext|>"].map(str::to_owned);
    let symbols = bytes.iter().cloned().chain(ends).chain(more);
    let vocabulary: serde_json::Map<_, _> = symbols.zip(0..).map(|(symbol, id)| (symbol, Value::from(id))).collect();
    std::fs::write(folder.join("vocab.json"), Value::Object(vocabulary).to_string()).unwrap();
    std::fs::write(folder.join("merges.txt"), "#version: 0.2\na b</w>\n").unwrap();
}

#[test]
fn padding_stands_in_the_folder() {
    let folder = tempfile::tempdir().unwrap();
    small_folder(folder.path());
    let padding = || load_tokenizer(folder.path()).map(|tokenizer| tokenizer.padding);
    assert_eq!(padding().unwrap(), Padding::EndToken);
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
    write("tokenizer_config.json", r#"{"pad_token": "<|endoftext|>", "model_max_length": 77}"#);
    assert_eq!(padding().unwrap(), Padding::EndToken);
    // Published folders of Stable Diffusion 2.1 disagree with themselves; this file wins.
    write("special_tokens_map.json", r#"{"pad_token": "!"}"#);
    assert_eq!(padding().unwrap(), Padding::Zero);
    write("special_tokens_map.json", r#"{"pad_token": {"content": "<|endoftext|>", "lstrip": false}}"#);
    assert_eq!(padding().unwrap(), Padding::EndToken);
    write("special_tokens_map.json", r#"{"pad_token": "a"}"#);
    assert!(matches!(padding(), Err(TextError::Format { .. })));
    let tokenizer = load_tokenizer(folder.path());
    assert!(tokenizer.unwrap_err().to_string().ends_with("special_tokens_map.json"));
}

#[test]
fn damaged_files_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let damage = |name: &str, change: &dyn Fn(String) -> String| {
        small_folder(folder.path());
        let path = folder.path().join(name);
        let text = change(std::fs::read_to_string(&path).unwrap());
        std::fs::write(&path, text).unwrap();
        let error = BytePairs::from_folder(folder.path()).unwrap_err();
        assert!(error.to_string().ends_with(&path.display().to_string()), "{error}");
        error.to_string()
    };
    let said = |error: String, what: &str| assert!(error.contains(what), "{error} does not say {what:?}");
    said(damage("vocab.json", &|text| text.replace("\"ab</w>\":512", "\"ab</w>\":511")), "is taken or leaves a gap");
    said(damage("vocab.json", &|text| text.replace("\"ab</w>\":512", "\"ab</w>\":4000000000")), "leaves a gap");
    said(damage("vocab.json", &|text| text[..100].to_owned()), "EOF");
    said(damage("merges.txt", &|text| text + "a b</w>\n"), "line 3: \"a b</w>\" stands here a second time");
    said(damage("merges.txt", &|text| text + "a b c\n"), "line 3: \"a b c\" is no pair");
    said(damage("merges.txt", &|text| text + "\n"), "line 3: \"\" is no pair");
    said(damage("merges.txt", &|text| text + "b a\n"), "line 3: \"ba\" is no token");
    small_folder(folder.path());
    std::fs::remove_file(folder.path().join("merges.txt")).unwrap();
    assert!(matches!(BytePairs::from_folder(folder.path()), Err(TextError::Io { .. })));
    let table = folder.path().join("table.txt");
    std::fs::write(&table, "header\na b</w>\n").unwrap();
    let error = BytePairs::from_table(&table).unwrap_err().to_string();
    said(error, "1 merges, CLIP has 48894");
    let packed = folder.path().join("table.txt.gz");
    std::fs::write(&packed, "no gzip").unwrap();
    assert!(matches!(BytePairs::from_table(&packed), Err(TextError::Io { .. })));
}

#[test]
fn a_vocabulary_without_a_byte_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    small_folder(folder.path());
    let path = folder.path().join("vocab.json");
    let text = std::fs::read_to_string(&path).unwrap().replace("\"q</w>\"", "\"q?\"");
    std::fs::write(&path, text).unwrap();
    let error = BytePairs::from_folder(folder.path()).unwrap_err().to_string();
    assert!(error.contains("\"q</w>\" is no token"), "{error}");
}
