//! Replays every file kept by the fuzzer (tests/fuzz) through the same readers: no panic, no bomb, no hang.
#![allow(clippy::unwrap_used, clippy::expect_used, missing_docs)]

#[path = "fuzz/readers.rs"]
mod readers;

use std::path::PathBuf;

/// As in the fuzzer: a reader that asks for more memory than the inputs can mean ends the test.
#[global_allocator]
static MEMORY: cap::Cap<std::alloc::System> = cap::Cap::new(std::alloc::System, 1 << 30);

#[test]
fn readers_survive_every_file_of_the_corpus() {
    // Panics inside the RAW decoder are caught by it.
    std::panic::set_hook(Box::new(|info| {
        if !info
            .location()
            .is_some_and(|l| l.file().contains("rawloader"))
        {
            eprintln!("{info}");
        }
    }));
    let corpus = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/fuzz/corpus");
    for (name, reader) in readers::READERS {
        let mut files: Vec<PathBuf> = std::fs::read_dir(corpus.join(name))
            .unwrap()
            .map(|f| f.unwrap().path())
            .collect();
        files.sort();
        assert!(!files.is_empty(), "{name}");
        for file in files {
            let bytes = std::fs::read(&file).unwrap();
            let begun = std::time::Instant::now();
            let read = std::panic::catch_unwind(|| reader(&bytes));
            assert!(read.is_ok(), "{} panics", file.display());
            // Typical: a millisecond.
            assert!(begun.elapsed().as_secs() < 10, "{} hangs", file.display());
        }
    }
}
