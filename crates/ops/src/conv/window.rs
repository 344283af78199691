//! Where a convolution's taps fall: sizes, padding and strides of the three axes.

/// Sizes of a convolution without its channels; a plane is a volume of depth 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Window {
    pub input: [usize; 3],
    pub taps: [usize; 3],
    pub stride: [usize; 3],
    pub padding: [usize; 3],
    pub output: [usize; 3],
}

/// A stretch of output cells whose inputs lie at a constant distance: `rows` cells from `output` on, the first tap of the first cell at `input`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Stretch {
    /// Cell of the output's scratch.
    pub output: usize,
    /// Cell of the padded input.
    pub input: usize,
    pub rows: usize,
}

impl Window {
    /// # Panics
    /// If a stride or a kernel size is 0, or the padded input is smaller than the kernel.
    pub fn new(input: [usize; 3], taps: [usize; 3], stride: [usize; 3], padding: [usize; 3]) -> Self {
        let output = std::array::from_fn(|i| {
            let padded = input[i] + 2 * padding[i];
            assert!(stride[i] > 0 && taps[i] > 0, "strides and kernels of a convolution start at 1");
            assert!(padded >= taps[i], "a kernel of {taps:?} does not fit {input:?} padded by {padding:?}");
            (padded - taps[i]) / stride[i] + 1
        });
        Self { input, taps, stride, padding, output }
    }

    /// Sizes of the padded input.
    pub fn padded(&self) -> [usize; 3] {
        std::array::from_fn(|i| self.input[i] + 2 * self.padding[i])
    }

    /// The convolution that carries gradients back to the input: over the upstream gradient spread by the stride, with the kernel flipped.
    pub fn reversed(&self) -> Self {
        let spread = std::array::from_fn(|i| self.input[i] + self.taps[i] - 1);
        Self { input: spread, taps: self.taps, stride: [1; 3], padding: [0; 3], output: self.input }
    }

    /// Whether output cell and input cell advance alike, so that rows of the output can lie as far apart as those of the padded input.
    fn dense(&self) -> bool {
        self.stride == [1; 3]
    }

    /// Row pitch and slice pitch of the output's scratch, in cells. A dense convolution keeps the padded input's, with unused cells at row ends.
    pub fn scratch_pitch(&self) -> [usize; 2] {
        let [_, y, x] = if self.dense() { self.padded() } else { self.output };
        [x, y * x]
    }

    /// Cells of the output's scratch.
    pub fn scratch_cells(&self) -> usize {
        let ([row, slice], [z, y, x]) = (self.scratch_pitch(), self.output);
        if z * y * x == 0 { 0 } else { (z - 1) * slice + (y - 1) * row + x }
    }

    /// The stretches that cover the output: one for a dense convolution, else one per row.
    pub fn stretches(&self) -> Vec<Stretch> {
        let rows = self.output[0] * self.output[1];
        self.stretches_of(0, if self.output[2] == 0 { 0 } else { rows })
    }

    /// The stretches that cover the output's rows `first..last`, counted through all slices; places in the scratch relative to row `first`.
    pub fn stretches_of(&self, first: usize, last: usize) -> Vec<Stretch> {
        if first == last {
            return Vec::new();
        }
        let start = self.scratch_row(first);
        if self.dense() {
            let rows = self.scratch_row(last - 1) + self.output[2] - start;
            return vec![Stretch { output: 0, input: start, rows }];
        }
        let ([_, y_count, x_count], [_, padded_y, padded_x]) = (self.output, self.padded());
        let stretch = |row: usize| {
            let (z, y) = (row / y_count, row % y_count);
            let input = (z * self.stride[0] * padded_y + y * self.stride[1]) * padded_x;
            Stretch { output: self.scratch_row(row) - start, input, rows: x_count }
        };
        (first..last).map(stretch).collect()
    }

    /// First cell of an output row in the scratch.
    pub fn scratch_row(&self, row: usize) -> usize {
        let ([row_pitch, slice_pitch], y_count) = (self.scratch_pitch(), self.output[1]);
        row / y_count * slice_pitch + row % y_count * row_pitch
    }

    /// Cuts the output's rows into runs of about `cells` cells. A run stays inside one slice, whose neighbours the scratch would hold unused
    /// cells for, unless all slices together are smaller.
    pub fn runs(&self, cells: usize) -> Vec<[usize; 2]> {
        let [z_count, y_count, x_count] = self.output;
        let rows = z_count * y_count;
        if rows * x_count <= cells {
            return vec![[0, rows]];
        }
        let length = (cells / x_count.max(1)).clamp(1, y_count);
        let slice = |z: usize| {
            let starts = (0..y_count).step_by(length);
            starts.map(move |y| [z * y_count + y, z * y_count + (y + length).min(y_count)])
        };
        (0..z_count).flat_map(slice).collect()
    }

    /// For each tap along z and y: its cell in the padded input relative to a stretch's first.
    pub fn tap_rows(&self) -> Vec<usize> {
        let [_, y, x] = self.padded();
        (0..self.taps[0]).flat_map(|tz| (0..self.taps[1]).map(move |ty| (tz * y + ty) * x)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes() {
        let same = Window::new([1, 8, 6], [1, 3, 3], [1; 3], [0, 1, 1]);
        assert_eq!((same.output, same.padded()), ([1, 8, 6], [1, 10, 8]));
        assert_eq!(same.scratch_cells(), 7 * 8 + 6);
        assert_eq!(same.reversed().output, [1, 8, 6]);
        let halved = Window::new([1, 8, 7], [1, 3, 3], [1, 2, 2], [0, 1, 1]);
        assert_eq!(halved.output, [1, 4, 4]);
        assert_eq!(halved.stretches()[1], Stretch { output: 4, input: 2 * 9, rows: 4 });
        assert_eq!(halved.stretches_of(1, 2), [Stretch { output: 0, input: 2 * 9, rows: 4 }]);
        assert_eq!(same.stretches_of(2, 4), [Stretch { output: 0, input: 2 * 8, rows: 8 + 6 }]);
    }

    #[test]
    fn runs_cover_every_row_once() {
        let window = Window::new([3, 5, 7], [3; 3], [1; 3], [1; 3]);
        assert_eq!(window.runs(1000), [[0, 15]]);
        for cells in [1, 7, 20, 35] {
            let runs = window.runs(cells);
            assert!(runs.iter().all(|[first, last]| first / 5 == (last - 1) / 5), "{runs:?}");
            assert!(
                runs.windows(2).all(|pair| pair[0][1] == pair[1][0])
                    && runs[0][0] == 0
                    && runs[runs.len() - 1][1] == 15
            );
        }
    }

    #[test]
    #[should_panic(expected = "does not fit")]
    fn a_kernel_must_fit() {
        let _ = Window::new([1, 2, 2], [1, 3, 3], [1; 3], [0; 3]);
    }
}
