//! What all targets share: an allocator that refuses bombs, and quiet panics of the decoder.

#[allow(dead_code)]
#[path = "readers.rs"]
pub(crate) mod readers;

/// Fails an allocation that takes the whole process over 512 MiB: the largest input is 64 KiB.
#[global_allocator]
static MEMORY: cap::Cap<std::alloc::System> = cap::Cap::new(std::alloc::System, 512 << 20);

/// Panics inside the RAW decoder are caught by it and are no fault of a reader; libFuzzer would end at any.
pub(crate) fn begin() {
    std::panic::set_hook(Box::new(|info| {
        if !info.location().is_some_and(|l| l.file().contains("rawloader")) {
            eprintln!("{info}");
        }
    }));
}
