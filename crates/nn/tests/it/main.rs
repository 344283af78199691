//! Integration tests of the shared layers.

mod lora;
mod lora_files;
mod lora_golden;
mod segments;
