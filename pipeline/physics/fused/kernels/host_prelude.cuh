#include <atomic>
#include <cmath>
#include <thread>
#include <vector>
#define __device__
#define __restrict__ __restrict
