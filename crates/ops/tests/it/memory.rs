//! No operation takes more memory than twice its inputs and outputs, on the way forward and on the way back.

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering};

use super::cases::{Feed, Order, Sizes, all};

/// Counts what the program holds.
struct Counting;

static HELD: AtomicUsize = AtomicUsize::new(0);
static HIGHEST: AtomicUsize = AtomicUsize::new(0);

#[allow(unsafe_code)]
// SAFETY: everything is passed on to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let held = HELD.fetch_add(layout.size(), Ordering::Relaxed) + layout.size();
        HIGHEST.fetch_max(held, Ordering::Relaxed);
        // SAFETY: passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        HELD.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: passed on.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Set in the process that measures.
const CHILD: &str = "RIGSCAPE_OPS_MEASURES_MEMORY";
/// Large enough that buffers of single threads do not count.
const SIZES: Sizes = Sizes { items: 3, tokens: 512, width: 64, height: 48, columns: 40, points: 8192 };

#[test]
fn peaks_stay_within_twice_inputs_and_outputs() {
    if std::env::var_os(CHILD).is_some() {
        return measure();
    }
    // Alone in a process: other tests allocate at the same time.
    let program = std::env::current_exe().expect("this test's program");
    let arguments = ["--exact", "memory::peaks_stay_within_twice_inputs_and_outputs", "--nocapture"];
    let output =
        std::process::Command::new(program).args(arguments).env(CHILD, "1").output().expect("a second process");
    let text = String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && text.contains("1 passed"), "{text}");
}

/// The highest memory that `body` takes beyond what is held before it.
fn peak(body: impl FnOnce()) -> usize {
    let before = HELD.load(Ordering::Relaxed);
    HIGHEST.store(before, Ordering::Relaxed);
    body();
    HIGHEST.load(Ordering::Relaxed) - before
}

fn measure() {
    let mut wrong = Vec::new();
    for case in all() {
        // The first run also brings the threads and packing buffers of the matrix product.
        let lengths: Vec<usize> = Feed::new(SIZES, Order::Plain, None).run(&case).iter().map(Vec::len).collect();
        let (output, inputs) = (4 * lengths[0], 4 * lengths[1..].iter().sum::<usize>());
        // The inputs are made inside, so that they stand in every bound once more; going back, each has a gradient, and so has the output.
        let forward = peak(|| Feed::new(SIZES, Order::Plain, None).forward(&case));
        let both = peak(|| drop(Feed::new(SIZES, Order::Plain, None).run(&case)));
        let bounds = [inputs + 2 * (inputs + output), inputs + 4 * (inputs + output)];
        eprintln!("{}: inputs {inputs}, output {output}, forward {forward}, with gradients {both}", case.name);
        for (what, took, bound) in [("forward", forward, bounds[0]), ("with gradients", both, bounds[1])] {
            if took > bound {
                wrong.push(format!("{} {what}: {took} of {bound} bytes", case.name));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}
