/* The start of a Cortex-M4 with an FPU, and output through the debugger or emulator (semihosting). Without either, let
   `put` write to a UART and `Reset_Handler` wait at its end: `bkpt` stops the processor. */

#include "board.h"
#include <stdint.h>

#define REGISTER(address) (*(volatile uint32_t *)(address))
#define CPACR REGISTER(0xe000ed88u)
#define SYST_CSR REGISTER(0xe000e010u)
#define SYST_RVR REGISTER(0xe000e014u)
#define SYST_CVR REGISTER(0xe000e018u)
#define PAINT 0xa5a5a5a5u

enum { SYS_WRITE0 = 0x04, SYS_EXIT = 0x18, APPLICATION_EXIT = 0x20026, RUN_TIME_ERROR = 0x20023 };

extern uint32_t stack_top[], data_start[], data_end[], data_load[], bss_start[], bss_end[];
int main(void);
void Reset_Handler(void);
void Fault_Handler(void);

static void semihosting(uint32_t operation, uint32_t argument) {
  register uint32_t r0 __asm__("r0") = operation;
  register uint32_t r1 __asm__("r1") = argument;
  __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
}

void put(const char *text) { semihosting(SYS_WRITE0, (uint32_t)text); }

unsigned ticks(void) { return SYST_CVR; }

unsigned stack_used(void) {
  const uint32_t *word = bss_end;
  while (word < stack_top && *word == PAINT) word++;
  return (unsigned)((stack_top - word) * 4);
}

void Reset_Handler(void) {
  uint32_t *to, *from = data_load, *frame = __builtin_frame_address(0);
  CPACR |= 0xfu << 20; /* the FPU */
  __asm__ volatile("dsb\n isb" ::: "memory");
  for (to = data_start; to < data_end;) *to++ = *from++;
  for (to = bss_start; to < bss_end;) *to++ = 0;
  for (to = bss_end; to < frame - 16;) *to++ = PAINT; /* the words of this frame stay */
  SYST_RVR = 0xffffff;
  SYST_CVR = 0;
  SYST_CSR = 5; /* on, at the processor's clock */
  semihosting(SYS_EXIT, main() ? RUN_TIME_ERROR : APPLICATION_EXIT);
  for (;;) continue;
}

void Fault_Handler(void) {
  put("fault\n");
  semihosting(SYS_EXIT, RUN_TIME_ERROR);
  for (;;) continue;
}

/* Reset, NMI and the four faults; no interrupt is enabled. */
__attribute__((section(".vectors"), used)) static const struct {
  uint32_t *stack;
  void (*handlers[6])(void);
} vectors = {stack_top, {Reset_Handler, Fault_Handler, Fault_Handler, Fault_Handler, Fault_Handler, Fault_Handler}};
