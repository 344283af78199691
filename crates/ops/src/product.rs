//! Matrix products of slices: a bounds-checked face of the crate `gemm`, which reaches the machine's peak on one core and takes any strides.

use crate::fused::{Blank, write_each};

/// A matrix inside a slice; element (i, j) is `data[i·row_stride + j·column_stride]`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Matrix<'a> {
    pub data: &'a [f32],
    pub rows: usize,
    pub columns: usize,
    pub row_stride: usize,
    pub column_stride: usize,
}

/// As [`Matrix`], to be written.
#[derive(Debug)]
pub(crate) struct MatrixMut<'a> {
    pub data: &'a mut [f32],
    pub rows: usize,
    pub columns: usize,
    pub row_stride: usize,
    pub column_stride: usize,
}

/// What becomes of the old values of a product's destination.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Old {
    /// Overwritten.
    Replaced,
    /// The product is added to them.
    Kept,
}

/// Products with at least this many multiplications are shared between threads.
const PARALLEL_FROM: usize = 192 * 192 * 192;

impl<'a> Matrix<'a> {
    /// Rows one after another.
    pub fn row_major(data: &'a [f32], rows: usize, columns: usize) -> Self {
        Self { data, rows, columns, row_stride: columns, column_stride: 1 }
    }

    /// `count` rows from row `first` on.
    ///
    /// # Panics
    /// If there are fewer rows.
    pub fn rows_at(self, first: usize, count: usize) -> Self {
        assert!(first + count <= self.rows, "rows {first} to {} of {}", first + count, self.rows);
        let data = &self.data[if count == 0 { 0 } else { first * self.row_stride }..];
        Self { data, rows: count, ..self }
    }

    /// Rows and columns exchanged.
    pub fn transposed(self) -> Self {
        Self {
            data: self.data,
            rows: self.columns,
            columns: self.rows,
            row_stride: self.column_stride,
            column_stride: self.row_stride,
        }
    }
}

impl<'a> MatrixMut<'a> {
    /// Rows one after another.
    pub fn row_major(data: &'a mut [f32], rows: usize, columns: usize) -> Self {
        Self { data, rows, columns, row_stride: columns, column_stride: 1 }
    }
}

/// Which threads a product may use.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Threads {
    /// The caller's alone, which shares the work otherwise.
    One,
    /// All, where the product is worth it.
    Shared,
}

/// Index behind the last element that the strides reach; 0 for an empty matrix.
fn extent(rows: usize, columns: usize, row_stride: usize, column_stride: usize) -> usize {
    if rows == 0 || columns == 0 { 0 } else { (rows - 1) * row_stride + (columns - 1) * column_stride + 1 }
}

/// `out = scale · a · b`, or `out += …` where the old values are kept. The bits do not depend on the number of threads: threads share rows and
/// columns of the result, never one sum.
///
/// # Panics
/// If the shapes disagree, a matrix does not fit its slice, or rows of `out` overlap.
pub(crate) fn product(out: MatrixMut<'_>, a: Matrix<'_>, b: Matrix<'_>, scale: f32, old: Old) {
    product_on(Threads::Shared, out, a, b, scale, old);
}

/// As [`product`], on the threads named.
pub(crate) fn product_on(threads: Threads, out: MatrixMut<'_>, a: Matrix<'_>, b: Matrix<'_>, scale: f32, old: Old) {
    check_inputs([out.rows, out.columns], a, b);
    assert!(
        extent(out.rows, out.columns, out.row_stride, out.column_stride) <= out.data.len(),
        "result leaves its slice"
    );
    let (m, n) = (out.rows, out.columns);
    let (long, short, inner) = if out.row_stride >= out.column_stride {
        (out.row_stride, out.column_stride, n)
    } else {
        (out.column_stride, out.row_stride, m)
    };
    assert!(m * n <= 1 || (short > 0 && long >= short * inner) || m == 1 || n == 1, "elements of the result overlap");
    #[allow(unsafe_code)]
    // SAFETY: every index that the strides reach lies inside its slice and the result's elements do not overlap, both checked above; the
    // borrows rule out that the result overlaps an input.
    unsafe {
        multiply(threads, out.data.as_mut_ptr(), [out.row_stride, out.column_stride], a, b, scale, old);
    }
}

/// `a · b`, row-major, into memory that is not written yet.
///
/// # Panics
/// If the shapes disagree, a matrix does not fit its slice, or `out` has another size than the result.
pub(crate) fn product_into<'a>(threads: Threads, out: &'a mut Blank, a: Matrix<'_>, b: Matrix<'_>) -> &'a mut [f32] {
    let (m, n) = (a.rows, b.columns);
    check_inputs([m, n], a, b);
    assert_eq!(out.len(), m * n, "size of the result");
    if a.columns == 0 {
        return write_each!(out, zero in &vec![0.0; m * n] => zero);
    }
    #[allow(unsafe_code)]
    // SAFETY: as in `product_on`; the result is as large as `out` and its old values are never read, so that all of `out` is written.
    unsafe {
        multiply(threads, out.as_mut_ptr().cast(), [n, 1], a, b, 1.0, Old::Replaced);
        out.assume_init_mut()
    }
}

fn check_inputs([m, n]: [usize; 2], a: Matrix<'_>, b: Matrix<'_>) {
    assert_eq!((a.rows, b.columns, b.rows), (m, n, a.columns), "shapes of a matrix product");
    for (x, what) in [(&a, "left"), (&b, "right")] {
        assert!(
            extent(x.rows, x.columns, x.row_stride, x.column_stride) <= x.data.len(),
            "{what} matrix leaves its slice"
        );
    }
}

#[allow(unsafe_code)]
/// # Safety
/// The inputs fit their slices and the result, `[a.rows, b.columns]` with these strides, its memory, whose elements do not overlap. Old values
/// that are kept have been written.
unsafe fn multiply(
    threads: Threads,
    out: *mut f32,
    [row_stride, column_stride]: [usize; 2],
    a: Matrix<'_>,
    b: Matrix<'_>,
    scale: f32,
    old: Old,
) {
    let (m, n, k) = (a.rows, b.columns, a.columns);
    if m == 0 || n == 0 {
        return;
    }
    let shared = threads == Threads::Shared && m * n * k >= PARALLEL_FROM;
    let parallelism = if shared { gemm::Parallelism::Rayon(0) } else { gemm::Parallelism::None };
    // SAFETY: passed on to the caller.
    unsafe {
        gemm::gemm(
            m,
            n,
            k,
            out,
            column_stride as isize,
            row_stride as isize,
            old == Old::Kept,
            a.data.as_ptr(),
            a.column_stride as isize,
            a.row_stride as isize,
            b.data.as_ptr(),
            b.column_stride as isize,
            b.row_stride as isize,
            1.0_f32,
            scale,
            false,
            false,
            false,
            parallelism,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wave(count: usize, phase: f32) -> Vec<f32> {
        (0..count).map(|i| (i as f32 * 0.37 + phase).sin()).collect()
    }

    fn naive(a: Matrix<'_>, b: Matrix<'_>, i: usize, j: usize) -> f32 {
        let at = |x: Matrix<'_>, i: usize, j: usize| x.data[i * x.row_stride + j * x.column_stride] as f64;
        (0..a.columns).map(|k| at(a, i, k) * at(b, k, j)).sum::<f64>() as f32
    }

    #[test]
    fn every_orientation_and_overlapping_rows_of_an_input() {
        let (data_a, data_b) = (wave(400, 0.0), wave(400, 1.0));
        let overlapping = Matrix { data: &data_a, rows: 11, columns: 12, row_stride: 4, column_stride: 1 };
        let plain = Matrix::row_major(&data_a, 11, 12);
        for a in [plain, overlapping, Matrix::row_major(&data_a, 12, 11).transposed()] {
            for b in [Matrix::row_major(&data_b, 12, 7), Matrix::row_major(&data_b, 7, 12).transposed()] {
                let mut out = vec![2.0; 77];
                product(MatrixMut::row_major(&mut out, 11, 7), a, b, 0.5, Old::Kept);
                for (i, value) in out.iter().enumerate() {
                    let expected = 2.0 + 0.5 * naive(a, b, i / 7, i % 7);
                    assert!((value - expected).abs() < 1e-5, "{value} {expected}");
                }
            }
        }
    }

    #[test]
    #[should_panic(expected = "leaves its slice")]
    fn a_matrix_must_fit_its_slice() {
        let data = [0.0; 6];
        let mut out = [0.0; 4];
        product(
            MatrixMut::row_major(&mut out, 2, 2),
            Matrix::row_major(&data, 2, 4),
            Matrix::row_major(&data, 4, 2),
            1.0,
            Old::Replaced,
        );
    }

    #[test]
    #[should_panic(expected = "overlap")]
    fn results_may_not_overlap() {
        let data = [0.0; 6];
        let mut out = [0.0; 6];
        let out = MatrixMut { data: &mut out, rows: 2, columns: 3, row_stride: 1, column_stride: 1 };
        product(out, Matrix::row_major(&data, 2, 2), Matrix::row_major(&data, 2, 3), 1.0, Old::Replaced);
    }

    #[test]
    fn bits_do_not_depend_on_the_number_of_threads() {
        let (a, b) = (wave(300 * 310, 0.0), wave(310 * 290, 1.0));
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let mut out = vec![0.0; 300 * 290];
            pool.install(|| {
                let (a, b) = (Matrix::row_major(&a, 300, 310), Matrix::row_major(&b, 310, 290));
                product(MatrixMut::row_major(&mut out, 300, 290), a, b, 1.0, Old::Replaced);
            });
            out
        };
        let one = run(1);
        assert!(one == run(2) && one == run(3));
    }
}
