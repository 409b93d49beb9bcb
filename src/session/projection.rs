//! Between the sample plane and the image.
