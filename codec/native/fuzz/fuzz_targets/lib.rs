//! Code that the targets share.

/// Decodes on the thread of the fuzzer: waking another one takes longer than a small input.
pub fn one_thread() {
    let pool = cores::ThreadPoolBuilder::new().num_threads(1).use_current_thread();
    pool.build_global().expect("the first and only pool");
}
