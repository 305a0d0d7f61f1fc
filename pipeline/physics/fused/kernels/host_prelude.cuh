#include <cmath>
#include <pthread.h>
#define __device__
#define __restrict__ __restrict
