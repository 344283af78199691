//! Memory of results: written once instead of zeroed first, and kept by the process once it is there.

use std::mem::MaybeUninit;

use rayon::prelude::*;

/// Numbers that are not written yet.
pub(crate) type Blank = [MaybeUninit<f32>];

/// A vector of `length` numbers, written in pieces of `piece` on all threads.
///
/// `fill(i, blank)` writes piece `i` and returns it, which only writing can bring about: see [`write_1`] and its like.
///
/// # Panics
/// If `fill` returns other memory than its piece.
pub(crate) fn written(
    length: usize,
    piece: usize,
    fill: impl for<'a> Fn(usize, &'a mut Blank) -> &'a mut [f32] + Sync,
) -> Vec<f32> {
    written_in_parts(length, length, piece, |_, i, blank| fill(i, blank))
}

/// As [`written`], in parts of `part` numbers that are cut into pieces each for itself: `fill(part, i, blank)`.
pub(crate) fn written_in_parts(
    length: usize,
    part: usize,
    piece: usize,
    fill: impl for<'a> Fn(usize, usize, &'a mut Blank) -> &'a mut [f32] + Sync,
) -> Vec<f32> {
    let mut memory = Box::<[f32]>::new_uninit_slice(length);
    memory.par_chunks_mut(part.max(1)).enumerate().for_each(|(part, memory)| {
        let pieces = memory.par_chunks_mut(piece.max(1)).enumerate();
        pieces.for_each(|(i, blank)| write_all(blank, |blank| fill(part, i, blank)));
    });
    #[allow(unsafe_code)]
    // SAFETY: the pieces cover the memory and each came back written.
    let memory = unsafe { memory.assume_init() };
    memory.into_vec()
}

/// Writes `out` row by row; `row(i, blank)` writes row `i` and returns it.
///
/// # Panics
/// If `row` returns other memory than its row.
#[inline(always)]
pub(crate) fn write_rows<'a>(
    out: &'a mut Blank,
    width: usize,
    mut row: impl for<'b> FnMut(usize, &'b mut Blank) -> &'b mut [f32],
) -> &'a mut [f32] {
    for (i, blank) in out.chunks_mut(width.max(1)).enumerate() {
        write_all(blank, |blank| row(i, blank));
    }
    #[allow(unsafe_code)]
    // SAFETY: the rows cover `out` and each came back written.
    unsafe {
        out.assume_init_mut()
    }
}

/// Runs `write`, which must hand back what it was given.
#[inline(always)]
fn write_all(blank: &mut Blank, write: impl for<'a> FnOnce(&'a mut Blank) -> &'a mut [f32]) {
    let place = (blank.as_ptr().addr(), blank.len());
    let written = write(blank);
    assert!((written.as_ptr().addr(), written.len()) == place, "a piece is written as a whole");
}

/// Writes `f(a)` of every element.
#[inline(always)]
pub(crate) fn write_1<'a>(out: &'a mut Blank, a: &[f32], f: impl Fn(f32) -> f32) -> &'a mut [f32] {
    assert_eq!(out.len(), a.len(), "one number per place");
    for (out, &a) in out.iter_mut().zip(a) {
        out.write(f(a));
    }
    #[allow(unsafe_code)]
    // SAFETY: `a` is as long as `out`, so that every place was written.
    unsafe {
        out.assume_init_mut()
    }
}

/// Writes `f(a, b, c)` of every triple of elements.
#[inline(always)]
pub(crate) fn write_3<'a>(
    out: &'a mut Blank,
    [a, b, c]: [&[f32]; 3],
    f: impl Fn(f32, f32, f32) -> f32,
) -> &'a mut [f32] {
    assert_eq!([a.len(), b.len(), c.len()], [out.len(); 3], "one number per place");
    for (((out, &a), &b), &c) in out.iter_mut().zip(a).zip(b).zip(c) {
        out.write(f(a, b, c));
    }
    #[allow(unsafe_code)]
    // SAFETY: `a`, `b` and `c` are as long as `out`, so that every place was written.
    unsafe {
        out.assume_init_mut()
    }
}

/// Tells the C library's allocator to keep memory that is freed instead of handing it back to the kernel at once.
///
/// Every operation gives a new tensor. By default its memory goes back when the tensor is dropped and comes again, zeroed page by page, for the
/// next: about half of the time of elementwise operations on large tensors. Memory in use at the highest point stays the same. Does something
/// on Linux with glibc only; for the start of programs that compute on a CPU.
pub fn keep_freed_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    {
        // From glibc's malloc.h.
        const M_TRIM_THRESHOLD: i32 = -1;
        const M_MMAP_THRESHOLD: i32 = -3;
        #[allow(unsafe_code)]
        unsafe extern "C" {
            fn mallopt(parameter: i32, value: i32) -> i32;
        }
        #[allow(unsafe_code)]
        // SAFETY: mallopt takes any value and changes the policy of later calls only.
        unsafe {
            mallopt(M_MMAP_THRESHOLD, 1 << 30);
            mallopt(M_TRIM_THRESHOLD, i32::MAX);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_arrive_in_order() {
        let source: Vec<f32> = (0..10).map(|i| i as f32).collect();
        let twice = written(10, 4, |i, blank| {
            let from = &source[4 * i..][..blank.len()];
            write_1(blank, from, |x| 2.0 * x)
        });
        assert_eq!(twice, source.iter().map(|x| 2.0 * x).collect::<Vec<_>>());
        assert_eq!(written(0, 0, |_, blank| write_1(blank, &[], |x| x)), Vec::<f32>::new());
    }

    #[test]
    #[should_panic(expected = "written as a whole")]
    fn other_memory_is_refused() {
        let _ = written(4, 4, |_, _| Box::leak(Box::new([0.0; 4])));
    }

    #[test]
    #[should_panic(expected = "written as a whole")]
    fn a_part_of_a_row_is_refused() {
        let mut memory = [MaybeUninit::uninit(); 4];
        let _ = write_rows(&mut memory, 4, |_, blank| write_1(&mut blank[..3], &[1.0; 3], |x| x));
    }
}
