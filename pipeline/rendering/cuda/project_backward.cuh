#define THREADS 128
#define SPHERES (THREADS / GROUP)
#define WIDE ((5 + F + 7) / 8 * 8)

// Sums a value of each sphere over the groups of cameras of a block; the result is valid in the first group.
__device__ __forceinline__ float summed(float value, float* shared) {
    if (GROUP == 1) return value;
    shared[threadIdx.x] = value;
    __syncthreads();
    float total = 0.0f;
    if (threadIdx.x < SPHERES) {
        for (int group = 0; group < GROUP; group++) total += shared[threadIdx.x + group * SPHERES];
    }
    __syncthreads();
    return total;
}

// Converts derivatives by centres in camera frames, k, log opacities and features to those by the inputs; a thread for
// each sphere and each of GROUP groups of cameras. Reads the rows (C, N, WIDE) of `composite_backward`. Writes by_means
// (N, 3), or (C, N, 3) where they differ by camera; by_scales (N); by_opacities (N); by_features (N, F).
extern "C" __global__ void __launch_bounds__(THREADS) project_backward(
    const float* gradients, const float* viewmats, const float* scales, const float* opacities, float* by_means,
    float* by_scales, float* by_opacities, float* by_features, int cameras, int N, int means_by_camera) {
    __shared__ float shared[THREADS];
    int n = blockIdx.x * SPHERES + threadIdx.x % SPHERES;
    bool inside = n < N;
    float sums[5 + F], mean[3] = {0.0f, 0.0f, 0.0f};
#pragma unroll
    for (int i = 0; i < 5 + F; i++) sums[i] = 0.0f;
    for (int camera = threadIdx.x / SPHERES; camera < cameras && inside; camera += GROUP) {
        long long row = (long long)camera * N + n;
        const float* gradient = gradients + row * WIDE;
        const float* V = viewmats + camera * 16;
#pragma unroll
        for (int i = 0; i < 3; i++) {
            float value = V[i] * gradient[0] + V[4 + i] * gradient[1] + V[8 + i] * gradient[2];
            mean[i] += value;
            if (means_by_camera) by_means[row * 3 + i] = value;
        }
#pragma unroll
        for (int i = 3; i < 5 + F; i++) sums[i] += gradient[i];
    }
#pragma unroll
    for (int i = 0; i < 3; i++) sums[i] = mean[i];
#pragma unroll
    for (int i = 0; i < 5 + F; i++) sums[i] = summed(sums[i], shared);
    if (!inside || threadIdx.x >= SPHERES) return;
    if (!means_by_camera) {
        for (int i = 0; i < 3; i++) by_means[n * 3 + i] = sums[i];
    }
    float s = scales[n], opacity = opacities[n];
    by_scales[n] = sums[3] / (s * s * s);
    by_opacities[n] = opacity > 1e-12f ? sums[4] / opacity : 0.0f;
#pragma unroll
    for (int i = 0; i < F; i++) by_features[(long long)n * F + i] = sums[5 + i];
}
