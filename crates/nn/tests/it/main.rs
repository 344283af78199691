//! Tests of the public surface, also against files that others wrote.

mod lora;
mod lora_files;
mod lora_golden;
mod segments;
mod torch;
mod torch_broken;
