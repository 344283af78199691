//! Fused kernels for the CPU backend `flex`: the machinery that makes one a differentiable tensor operation.

mod dispatch;
mod memory;
mod simd;

pub(crate) use dispatch::{Kernel, fused_1, fused_2, fused_3, on_flex};
pub use memory::keep_freed_memory;
pub(crate) use memory::{Blank, write_each, write_rows, written, written_in_parts};
pub(crate) use simd::{exp_difference, largest, sum, sum_of_products, sum_of_squares, vectorized};
#[cfg(target_arch = "x86_64")]
pub(crate) use simd::{has_avx2, has_avx512};

use std::cell::Cell;

thread_local! {
    static COMPOSED_ONLY: Cell<bool> = const { Cell::new(false) };
}

/// Runs `body` with every operation of this crate composed from burn's own operations, also where a fused kernel exists.
///
/// The choice holds for the calling thread and is made on the way forward: a gradient taken later follows it. Meant for
/// tests, benches and for finding out whether a kernel is to blame.
pub fn composed_only<R>(body: impl FnOnce() -> R) -> R {
    struct Restore(bool);
    impl Drop for Restore {
        fn drop(&mut self) {
            COMPOSED_ONLY.set(self.0);
        }
    }
    let _restore = Restore(COMPOSED_ONLY.replace(true));
    body()
}

pub(crate) fn is_composed_only() -> bool {
    COMPOSED_ONLY.get()
}
