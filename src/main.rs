//! The `goniofit` program: calls [`goniofit::cli`], prints the cause chain, returns the exit code.

fn main() -> std::process::ExitCode {
    goniofit::cli::main()
}
