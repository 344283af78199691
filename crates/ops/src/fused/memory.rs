//! Memory of results: written once instead of zeroed first, and kept by the process once it is there.

use std::mem::MaybeUninit;

use rayon::prelude::*;

/// Numbers that are not written yet.
pub(crate) type Blank = [MaybeUninit<f32>];

/// A vector of `length` numbers, written in pieces of `piece` on all threads.
///
/// `fill(i, blank)` writes piece `i` and returns it, which only writing can bring about: see [`write_each`] and [`write_rows`].
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

/// Runs `write`, which must hand back what it was given.
#[inline(always)]
fn write_all(blank: &mut Blank, write: impl for<'a> FnOnce(&'a mut Blank) -> &'a mut [f32]) {
    let place = (blank.as_ptr().addr(), blank.len());
    let written = write(blank);
    assert!((written.as_ptr().addr(), written.len()) == place, "a piece is written as a whole");
}

/// Writes one number per place of blank memory, computed from the elements of slices, and gives the memory as numbers.
///
/// `write_each!(out, x in a, y in b => x + y)`. A macro and no function of a closure: the loop has to become part of the [`vectorized`] function
/// around it. Panics if the lengths differ.
///
/// [`vectorized`]: super::vectorized
macro_rules! write_each {
    ($out:expr, $($value:ident in $slice:expr),+ => $number:expr) => {{
        let out: &mut $crate::fused::Blank = $out;
        let length = out.len();
        $(let $value: &[f32] = $slice; assert_eq!($value.len(), length, "one number per place");)+
        for i in 0..length {
            $(let $value = $value[i];)+
            out[i].write($number);
        }
        #[allow(unsafe_code)]
        // SAFETY: the loop wrote every place.
        unsafe { out.assume_init_mut() }
    }};
}
pub(crate) use write_each;

/// Writes blank memory row by row and gives it as numbers: `write_rows!(out, width, (i, row) => …)`, where the expression writes row `i` and is
/// that row as numbers. Panics if it is anything else.
macro_rules! write_rows {
    ($out:expr, $width:expr, ($i:ident, $row:ident) => $written:expr) => {{
        let out: &mut $crate::fused::Blank = $out;
        for ($i, $row) in out.chunks_mut($width).enumerate() {
            let place = ($row.as_ptr().addr(), $row.len());
            let written: &mut [f32] = $written;
            assert!((written.as_ptr().addr(), written.len()) == place, "a row is written as a whole");
        }
        #[allow(unsafe_code)]
        // SAFETY: the rows cover `out` and each came back written.
        unsafe {
            out.assume_init_mut()
        }
    }};
}
pub(crate) use write_rows;

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
            // Older versions refuse more than 32 MiB; larger tensors then keep going back.
            if mallopt(M_MMAP_THRESHOLD, 1 << 30) == 0 {
                mallopt(M_MMAP_THRESHOLD, 32 << 20);
            }
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
            write_each!(blank, x in from => 2.0 * x)
        });
        assert_eq!(twice, source.iter().map(|x| 2.0 * x).collect::<Vec<_>>());
        let rows = written(
            10,
            10,
            |_, blank| write_rows!(blank, 5, (i, row) => write_each!(row, a in &source[..5], b in &source[5..] => a + b * i as f32)),
        );
        assert_eq!(rows, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 7.0, 9.0, 11.0, 13.0]);
        assert!(written(0, 0, |_, blank| write_each!(blank, x in &[] => x)).is_empty());
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
        let _ = write_rows!(&mut memory, 4, (_i, row) => write_each!(&mut row[..3], x in &[1.0; 3] => x));
    }
}
