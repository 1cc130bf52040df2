//! Buffers aligned to cache lines.

use aligned_vec::{AVec, avec};

/// A vector aligned to cache lines, so that no register is loaded from two lines.
pub type AlignedVec<T> = AVec<T>;

/// A buffer of `len` zeros.
pub fn zeros<T: Copy + Default>(len: usize) -> AlignedVec<T> {
    avec![T::default(); len]
}

/// The first `len` elements of a buffer. A shorter buffer grows, with zeros; it never shrinks.
pub fn resize<T: Copy + Default>(buffer: &mut AlignedVec<T>, len: usize) -> &mut [T] {
    if buffer.len() < len {
        buffer.resize(len, T::default());
    }
    &mut buffer[..len]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buffers_are_aligned_and_grow_with_zeros() {
        let mut buffer = zeros::<f32>(3);
        buffer[2] = 7.0;
        assert_eq!(resize(&mut buffer, 5), [0.0, 0.0, 7.0, 0.0, 0.0]);
        assert_eq!(resize(&mut buffer, 2), [0.0, 0.0]);
        assert_eq!(buffer.len(), 5, "it never shrinks");
        assert!(buffer.as_ptr().addr().is_multiple_of(64));
    }
}
